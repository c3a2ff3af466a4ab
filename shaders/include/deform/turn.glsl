// A rotation about an axis by an angle that grows along the mesh: q = c + R_b(a u(p)) (p - c), u(p) = s . p + s0.
// rows: b | c | s, s0 | a;  rate: a's;  change: a's.

float turn_share(vec3 p)
{
    return dot(shape[2].xyz, p) + shape[2].w;
}

vec3 turned(vec3 v, float angle)
{
    vec3 b = shape[0].xyz;
    float half_sine = sine(0.5 * angle);
    // Rodrigues' formula; 1 - cos a is written as 2 sin^2(a/2), which keeps its digits at small angles.
    return v + cross(b, v) * sine(angle) + cross(b, cross(b, v)) * (2.0 * half_sine * half_sine);
}

vec3 deformed(vec3 p)
{
    return shape[1].xyz + turned(p - shape[1].xyz, shape[3].x * turn_share(p));
}

vec3 deformed_rate(vec3 p)
{
    float u = turn_share(p);
    return cross(shape[0].xyz, turned(p - shape[1].xyz, shape[3].x * u)) * (shape[SHAPE_RATE + 3].x * u);
}

// The difference of two rotations is a chord: perpendicular to the direction halfway, twice the sine of half the angle.
vec3 deformed_change(vec3 p, int other)
{
    float u = turn_share(p), half_turn = 0.5 * shape[other + 3].x * u;
    return cross(shape[0].xyz, turned(p - shape[1].xyz, shape[3].x * u + half_turn)) * (2.0 * sine(half_turn));
}

// The gradient of q is (1 + w g^T) R with w = b x R (p - c) and g = a R s; cofactors: n to (1 + w.g) R n - g (w.R n).
vec3 deformed_normal(vec3 p, vec3 n)
{
    float angle = shape[3].x * turn_share(p);
    vec3 w = cross(shape[0].xyz, turned(p - shape[1].xyz, angle));
    vec3 g = shape[3].x * turned(shape[2].xyz, angle), N = turned(n, angle);
    return N * (1.0 + dot(w, g)) - g * dot(w, N);
}

vec3 deformed_normal_rate(vec3 p, vec3 n)
{
    vec3 b = shape[0].xyz;
    float a = shape[3].x, a_rate = shape[SHAPE_RATE + 3].x, u = turn_share(p), turning = a_rate * u;
    vec3 w = cross(b, turned(p - shape[1].xyz, a * u)), s = turned(shape[2].xyz, a * u), N = turned(n, a * u);
    vec3 g = a * s, w_rate = turning * cross(b, w), g_rate = a_rate * s + turning * a * cross(b, s);
    // w and N rotate together: w.N is constant.
    return N * (dot(w_rate, g) + dot(w, g_rate)) + (1.0 + dot(w, g)) * turning * cross(b, N) - g_rate * dot(w, N);
}
