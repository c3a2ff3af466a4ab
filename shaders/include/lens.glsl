// A lens that distorts (blinkgl/camera): what a change of place on the image plane at distance 1 is in its pixels.
// RADTAN, EQUIDISTANT: which model.
uniform vec4 lens_plane; // place on the image plane: ndc * lens_plane.xy + lens_plane.zw
uniform vec2 lens_focal; // px
uniform float lens_limit; // radius on the image plane up to which the model goes
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
    return mat2(ratio + 2.0 * u.x * u.x * slope + 2.0 * p1 * u.y + 6.0 * p2 * u.x, cross_term,
                cross_term, ratio + 2.0 * u.y * u.y * slope + 6.0 * p1 * u.y + 2.0 * p2 * u.x);
}

bool lens_sees(vec2 u)
{
    mat2 slope = lens_slope(u);
    return length(u) < lens_limit && slope[0][0] > 0.0 && determinant(slope) > 0.0;
}

// D(u + d) - D(u), each difference of powers written as a product with d, so that nothing cancels
vec2 lens_difference(vec2 u, vec2 d)
{
    vec2 v = u + d;
    float r2 = dot(u, u), s2 = dot(v, v), change = dot(d, u + v); // s2 - r2
    float ratio_change = change * (lens_k[0] + lens_k[1] * (r2 + s2) + lens_k[4] * (r2 * r2 + r2 * s2 + s2 * s2));
    float product = d.x * v.y + u.x * d.y; // v.x v.y - u.x u.y
    vec2 squares = d * (u + v);
    return d * lens_ratio(s2) + u * ratio_change + 2.0 * product * vec2(lens_k[2], lens_k[3])
         + vec2(lens_k[3] * (change + 2.0 * squares.x), lens_k[2] * (change + 2.0 * squares.y));
}
#endif

#ifdef EQUIDISTANT
// atan(x) to the last place or two, relatively, also of x near 0: tan of the quarter, then its series. What cards have is
// good to 1e-5, which is 1e-3 px of a flow of 100.
float lens_atan(float x)
{
    float t = x / (1.0 + sqrt(1.0 + x * x));
    t /= 1.0 + sqrt(1.0 + t * t);
    float t2 = t * t;
    return 4.0 * t * (1.0 + t2 * (-1.0 / 3.0 + t2 * (0.2 + t2 * (-1.0 / 7.0 + t2 * (1.0 / 9.0 + t2 * (-1.0 / 11.0 + t2 / 13.0))))));
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

// (g(b) - g(a)) / (b - a)
float lens_g_chord(float a, float b)
{
    float sum = 1.0, a2 = a * a, b2 = b * b, ab = a * b, even = a2 + ab + b2; // b^3 - a^3 over b - a
    // b^(n+2) - a^(n+2) over b - a is b^2 times that of n, plus a^n (b + a)
    float an = a2 * a, chord = even;
    sum += lens_k[0] * chord;
    for (int i = 1; i < 4; ++i)
    {
        chord = b2 * chord + an * (a + b);
        an *= a2;
        sum += lens_k[i] * chord;
    }
    return sum;
}

mat2 lens_slope(vec2 u)
{
    float r = length(u), t = lens_atan(r);
    if (r < 1e-4)
        return mat2(1.0);
    vec2 e = u / r;
    float along = lens_g_rate(t) / (1.0 + r * r), across = lens_g(t) / r;
    return mat2(along * e.x * e.x + across * e.y * e.y, (along - across) * e.x * e.y,
                (along - across) * e.x * e.y, along * e.y * e.y + across * e.x * e.x);
}

bool lens_sees(vec2 u)
{
    return length(u) < lens_limit;
}

// D(u) = s(r) u with s = g(atan r) / r; D(u + d) - D(u) = s' d + (s' - s) u
vec2 lens_difference(vec2 u, vec2 d)
{
    vec2 v = u + d;
    float r = length(u), q = length(v);
    if (min(r, q) < 1e-3) // s is 1 but for terms of r^2, in which nothing is lost
        return v * (q > 1e-6 ? lens_g(lens_atan(q)) / q : 1.0) - u * (r > 1e-6 ? lens_g(lens_atan(r)) / r : 1.0);
    float longer = dot(d, u + v) / (q + r);             // q - r
    float turned = lens_atan(longer / (1.0 + q * r));        // theta' - theta
    float g = lens_g(lens_atan(r)), g_change = turned * lens_g_chord(lens_atan(r), lens_atan(q));
    float s_change = (g_change - g * longer / r) / q;
    return d * (lens_g(lens_atan(q)) / q) + u * s_change;
}
#endif
