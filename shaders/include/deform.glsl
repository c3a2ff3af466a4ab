// A deforming shape, q(p, t) instead of p (blinkgl/scene/shapes): included by vertex.glsl only in the variants of such
// shapes. One of DEFORM_<NAME> is defined; include/deform/<name>.glsl or its class's text has
//   vec3 deformed(vec3 p)                      q
//   vec3 deformed_rate(vec3 p)                 dq/dt
//   vec3 deformed_change(vec3 p, int other)    q at the other time minus q, never as the difference of two positions
//   vec3 deformed_normal(vec3 p, vec3 n)       direction of the normal n of p
//   vec3 deformed_normal_rate(vec3 p, vec3 n)  its rate
// from the class's numbers: SHAPE_ROWS rows for now, for the rate, and for the other times of flow.
layout(std140) uniform Shape
{
    vec4 shape[4 * SHAPE_ROWS];
};
// First rows; those of the present time begin at 0.
const int SHAPE_RATE = SHAPE_ROWS, SHAPE_FORWARD = 2 * SHAPE_ROWS, SHAPE_BACKWARD = 3 * SHAPE_ROWS;

// sin and cos with float32's precision, relative near 0: drivers' own are only accurate to 2^-21, which would exceed a
// small motion. Angles beyond some hundred turns lose digits.
float sine(float x)
{
    float k = round(x * 0.31830988618);
    float r = (x - k * 3.140625) - k * 9.67653589793e-4; // pi in two parts, the first with few digits
    float s = r * r;
    float series = -1.9841269841e-4 + s * (2.7557319224e-6 - s * 2.5052108385e-8);
    float y = r + r * s * (-1.6666666667e-1 + s * (8.3333333333e-3 + s * series));
    return mod(k, 2.0) < 0.5 ? y : -y;
}

float cosine(float x)
{
    return sine(x + 1.57079632679);
}

#include "deforms.glsl"
