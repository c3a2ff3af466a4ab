// Single precision whose every operation is that of IEEE 754, to nearest even: the card's own, each operation by itself,
// or, where blinkgl/card/proof.py has found that it rounds otherwise, whole numbers. FLOAT is the type. (With SOFT_DIVISION
// quotients and roots alone are whole numbers: GLSL allows them 2.5 units in the last place.)
#include "soft_float.glsl"
#ifdef SOFT_FLOAT
#define FLOAT uint
#define FLOAT_OF(BITS) (BITS)
#define BITS_OF(FLOAT_) (FLOAT_)
#else
#define FLOAT float
#define FLOAT_OF(BITS) uintBitsToFloat(BITS)
#define BITS_OF(FLOAT_) floatBitsToUint(FLOAT_)

float add_float(float a, float b)
{
    precise float sum = a + b;
    return sum;
}

float mul_float(float a, float b)
{
    precise float product = a * b;
    return product;
}

float div_float(float a, float b)
{
#ifdef SOFT_DIVISION
    return uintBitsToFloat(div_float(floatBitsToUint(a), floatBitsToUint(b)));
#else
    precise float quotient = a / b;
    return quotient;
#endif
}

float sqrt_float(float a)
{
#ifdef SOFT_DIVISION
    return uintBitsToFloat(sqrt_float(floatBitsToUint(a)));
#else
    precise float root = sqrt(a);
    return root;
#endif
}
#endif

FLOAT negative_float(FLOAT a)
{
    return FLOAT_OF(BITS_OF(a) ^ 0x80000000u);
}

FLOAT sub_float(FLOAT a, FLOAT b)
{
    return add_float(a, negative_float(b));
}

#ifdef SOFT_FLOAT
// Whole numbers in the order of the floats; both zeros are 0.
int order_of(uint a)
{
    int size = int(a & 0x7FFFFFFFu);
    return a >> 31 == 1u ? -size : size;
}

bool less_float(uint a, uint b)
{
    return order_of(a) < order_of(b);
}
#else
bool less_float(float a, float b)
{
    return a < b;
}
#endif

FLOAT float_of(int whole) // below 2^24
{
    if (whole == 0) {
        return FLOAT_OF(0u);
    }
    uint size = uint(abs(whole));
    int top = findMSB(size);
    return FLOAT_OF((whole < 0 ? 0x80000000u : 0u) | ((uint(top + 127) << 23) + ((size << uint(23 - top)) - 0x800000u)));
}
