// Logarithms of many numbers, for blinkgl/card/proof.py: every second one by the scalar function, the others by that of
// four.
#include "log_q25.glsl"
layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly restrict buffer Given { vec4 given[]; };
layout(std430, binding = 1) writeonly restrict buffer Taken { ivec4 taken[]; };
uniform float eps;

void main()
{
    uint i = gl_GlobalInvocationID.x;
    if (i >= uint(given.length())) {
        return;
    }
    vec4 v = given[i];
    ivec4 four = log_of(v, eps);
    taken[i] = ivec4(four.x, log_of(v.y, eps), four.z, log_of(v.w, eps));
}
