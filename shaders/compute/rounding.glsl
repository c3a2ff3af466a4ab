// Differences, products, quotients and roots of pairs of numbers, for blinkgl/card/proof.py.
#include "doubles.glsl"
layout(local_size_x = 64) in;

#ifdef DOUBLES
#define WORDS uvec2
#else
#define WORDS uint
#endif
layout(std430, binding = 0) readonly restrict buffer First { WORDS first[]; };
layout(std430, binding = 1) readonly restrict buffer Second { WORDS second[]; };
layout(std430, binding = 2) writeonly restrict buffer Taken { WORDS taken[]; };

void main()
{
    uint i = gl_GlobalInvocationID.x;
    if (i >= uint(first.length())) {
        return;
    }
#ifdef DOUBLES
    DOUBLE a = DOUBLE_OF(first[i]), b = DOUBLE_OF(second[i]);
    taken[4u * i] = WORDS_OF(sub_double(a, b));
    taken[4u * i + 1u] = WORDS_OF(mul_double(a, b));
    taken[4u * i + 2u] = WORDS_OF(div_double(a, b));
    taken[4u * i + 3u] = WORDS_OF(sqrt_double(a));
#else
    FLOAT a = FLOAT_OF(first[i]), b = FLOAT_OF(second[i]);
    taken[4u * i] = BITS_OF(sub_float(a, b));
    taken[4u * i + 1u] = BITS_OF(mul_float(a, b));
    taken[4u * i + 2u] = BITS_OF(div_float(a, b));
    taken[4u * i + 3u] = BITS_OF(sqrt_float(a));
#endif
}
