// A lens with distortion: displacement between two places on the image plane (lens.glsl: derivative at one).
#include "lens.glsl"
uniform float lens_limit; // largest radius on the image plane for which the model is valid

#ifdef RADTAN
bool lens_sees(vec2 u)
{
    mat2 slope = lens_slope(u);
    return length(u) < lens_limit && slope[0][0] > 0.0 && determinant(slope) > 0.0;
}

// D(u + d) - D(u), each difference of powers written as a product with d, so that nothing cancels.
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

bool lens_sees(vec2 u)
{
    return length(u) < lens_limit;
}

// D(u) = s(r) u with s = g(atan r) / r; D(u + d) - D(u) = s' d + (s' - s) u
vec2 lens_difference(vec2 u, vec2 d)
{
    vec2 v = u + d;
    float r = length(u), q = length(v);
    if (min(r, q) < 1e-3) // s is 1 except for terms of r^2, so nothing cancels
        return v * (q > 1e-6 ? lens_g(lens_atan(q)) / q : 1.0) - u * (r > 1e-6 ? lens_g(lens_atan(r)) / r : 1.0);
    float longer = dot(d, u + v) / (q + r);             // q - r
    float turned = lens_atan(longer / (1.0 + q * r));        // theta' - theta
    float g = lens_g(lens_atan(r)), g_change = turned * lens_g_chord(lens_atan(r), lens_atan(q));
    float s_change = (g_change - g * longer / r) / q;
    return d * (lens_g(lens_atan(q)) / q) + u * s_change;
}
#endif
