// A scale about a point: q = c + f * (p - c).
// rows: c | f;  rate: f's;  change: f's.

vec3 deformed(vec3 p)
{
    return shape[0].xyz + shape[1].xyz * (p - shape[0].xyz);
}

vec3 deformed_rate(vec3 p)
{
    return shape[SHAPE_RATE + 1].xyz * (p - shape[0].xyz);
}

vec3 deformed_change(vec3 p, int other)
{
    return shape[other + 1].xyz * (p - shape[0].xyz);
}

vec3 deformed_normal(vec3 p, vec3 n)
{
    // Normals are scaled by the inverse of the positions' scale.
    return n / shape[1].xyz;
}

vec3 deformed_normal_rate(vec3 p, vec3 n)
{
    return -n * shape[SHAPE_RATE + 1].xyz / (shape[1].xyz * shape[1].xyz);
}
