// Two plane waves: q = p + d e(p) (A1 sin(k1 . p + phi1) + A2 sin(k2 . p + phi2)).
// rows: d | e, e0 | k1, phi1 | k2, phi2 | A1, A2;  rate: last row d(phi) A;  change: half of phi's, 2 A sin of it.

vec2 wave_angles(vec3 p)
{
    return vec2(dot(shape[2].xyz, p) + shape[2].w, dot(shape[3].xyz, p) + shape[3].w);
}

float wave_envelope(vec3 p)
{
    return dot(shape[1].xyz, p) + shape[1].w;
}

vec3 deformed(vec3 p)
{
    vec2 a = wave_angles(p);
    return p + shape[0].xyz * (wave_envelope(p) * (shape[4].x * sine(a.x) + shape[4].y * sine(a.y)));
}

vec3 deformed_rate(vec3 p)
{
    vec2 a = wave_angles(p), rate = shape[SHAPE_RATE + 4].xy;
    return shape[0].xyz * (wave_envelope(p) * (rate.x * cosine(a.x) + rate.y * cosine(a.y)));
}

vec3 deformed_change(vec3 p, int other)
{
    vec4 change = shape[other + 4];
    // sin(a + d) - sin(a) = 2 sin(d/2) cos(a + d/2): change.xy are d/2, change.zw 2 A sin(d/2).
    vec2 a = wave_angles(p) + change.xy;
    return shape[0].xyz * (wave_envelope(p) * (change.z * cosine(a.x) + change.w * cosine(a.y)));
}

// The gradient of q is 1 + d g^T with the slope g of the height; its cofactors take n to (1 + d.g) n - g (d.n).
vec3 deformed_normal(vec3 p, vec3 n)
{
    vec2 a = wave_angles(p);
    vec3 slope = shape[1].xyz * (shape[4].x * sine(a.x) + shape[4].y * sine(a.y))
               + wave_envelope(p) * (shape[4].x * cosine(a.x) * shape[2].xyz + shape[4].y * cosine(a.y) * shape[3].xyz);
    return n * (1.0 + dot(shape[0].xyz, slope)) - slope * dot(shape[0].xyz, n);
}

vec3 deformed_normal_rate(vec3 p, vec3 n)
{
    vec2 a = wave_angles(p), rate = shape[SHAPE_RATE + 4].xy;
    vec3 slope_rate = shape[1].xyz * (rate.x * cosine(a.x) + rate.y * cosine(a.y))
                    - wave_envelope(p) * (rate.x * sine(a.x) * shape[2].xyz + rate.y * sine(a.y) * shape[3].xyz);
    return n * dot(shape[0].xyz, slope_rate) - slope_rate * dot(shape[0].xyz, n);
}
