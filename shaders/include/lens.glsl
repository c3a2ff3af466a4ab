// A lens with distortion (blinkgl/camera): converts a displacement on the image plane at distance 1 to its pixels.
// RADTAN, EQUIDISTANT: which model.
uniform vec4 lens_plane; // position on the image plane: ndc * lens_plane.xy + lens_plane.zw
uniform vec2 lens_focal; // px
uniform float lens_k[5];

vec2 on_plane(vec2 ndc)
{
    return ndc * lens_plane.xy + lens_plane.zw;
}

#ifdef RADTAN
// k1, k2, p1, p2, k3
float lens_ratio(float r2)
{
    return 1.0 + r2 * (lens_k[0] + r2 * (lens_k[1] + r2 * lens_k[4]));
}

mat2 lens_slope(vec2 u)
{
    float r2 = dot(u, u), ratio = lens_ratio(r2), p1 = lens_k[2], p2 = lens_k[3];
    float slope = lens_k[0] + r2 * (2.0 * lens_k[1] + 3.0 * r2 * lens_k[4]); // d ratio / d r2
    float cross_term = 2.0 * (u.x * u.y * slope + p1 * u.x + p2 * u.y);
    // The Jacobian of the radial-tangential model (Brown; OpenCV's k1, k2, p1, p2, k3); it is symmetric.
    return mat2(ratio + 2.0 * u.x * u.x * slope + 2.0 * p1 * u.y + 6.0 * p2 * u.x, cross_term,
                cross_term, ratio + 2.0 * u.y * u.y * slope + 6.0 * p1 * u.y + 2.0 * p2 * u.x);
}
#endif

#ifdef EQUIDISTANT
// atan(x) to the last place or two, relatively, also for x near 0: tan of the quarter, then its series. GPUs' own is
// accurate to 1e-5, which is 1e-3 px of a flow of 100.
float lens_atan(float x)
{
    // tan(a/2) = tan a / (1 + sqrt(1 + tan^2 a)), twice.
    float t = x / (1.0 + sqrt(1.0 + x * x));
    t /= 1.0 + sqrt(1.0 + t * t);
    float t2 = t * t;
    float series = -1.0 / 7.0 + t2 * (1.0 / 9.0 + t2 * (-1.0 / 11.0 + t2 / 13.0));
    return 4.0 * t * (1.0 + t2 * (-1.0 / 3.0 + t2 * (0.2 + t2 * series)));
}

// k1 to k4; g(theta) is the distance from the principal point
float lens_g(float t)
{
    float t2 = t * t;
    return t * (1.0 + t2 * (lens_k[0] + t2 * (lens_k[1] + t2 * (lens_k[2] + t2 * lens_k[3]))));
}

float lens_g_rate(float t)
{
    float t2 = t * t;
    return 1.0 + t2 * (3.0 * lens_k[0] + t2 * (5.0 * lens_k[1] + t2 * (7.0 * lens_k[2] + t2 * 9.0 * lens_k[3])));
}

mat2 lens_slope(vec2 u)
{
    float r = length(u), t = lens_atan(r);
    if (r < 1e-4)
        return mat2(1.0);
    // Along the radius theta changes by dr / (1 + r^2); across it a circle of radius r becomes one of radius g(theta).
    vec2 e = u / r;
    float along = lens_g_rate(t) / (1.0 + r * r), across = lens_g(t) / r;
    return mat2(along * e.x * e.x + across * e.y * e.y, (along - across) * e.x * e.y,
                (along - across) * e.x * e.y, along * e.y * e.y + across * e.x * e.x);
}
#endif
