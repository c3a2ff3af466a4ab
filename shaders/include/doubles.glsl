// Double precision whose every operation is that of IEEE 754, to nearest even: the card's own where blinkgl/card/proof.py
// has found that it rounds so, else (SOFT_DOUBLE) whole numbers. DOUBLE is the type.
#include "floats.glsl"
#include "soft_double.glsl"
#ifdef SOFT_DOUBLE
#define DOUBLE uvec2
#define DOUBLE_OF(BITS) (BITS)
#define WORDS_OF(DOUBLE_) (DOUBLE_)
#else
#define DOUBLE double
#define DOUBLE_OF(BITS) packDouble2x32(BITS)
#define WORDS_OF(DOUBLE_) unpackDouble2x32(DOUBLE_)

double add_double(double a, double b)
{
    precise double sum = a + b;
    return sum;
}

double mul_double(double a, double b)
{
    precise double product = a * b;
    return product;
}

double div_double(double a, double b)
{
    precise double quotient = a / b;
    return quotient;
}

double sqrt_double(double a)
{
    precise double root = sqrt(a);
    return root;
}

double negative(double a)
{
    return -a;
}

bool less_double(double a, double b)
{
    return a < b;
}

double scaled(double a, int n) // neither end is zero or infinite
{
    return packDouble2x32(scaled(unpackDouble2x32(a), n));
}
#endif

DOUBLE sub_double(DOUBLE a, DOUBLE b)
{
    return add_double(a, negative(b));
}

bool is_zero(DOUBLE a)
{
    return exponent_of(WORDS_OF(a)) == 0;
}

DOUBLE widened(FLOAT a)
{
    uint bits = BITS_OF(a), sign = bits & 0x80000000u;
    bool zero = ((bits >> 23) & 0xFFu) == 0u;
    return DOUBLE_OF(zero ? uvec2(0u, sign) : uvec2(bits << 29, sign | (((bits & 0x7FFFFFFFu) >> 3) + (896u << 20))));
}

FLOAT narrowed(DOUBLE a)
{
    uvec2 words = WORDS_OF(a), mantissa = mantissa_of(words), kept = right64(mantissa, 22u);
    uint lost = uint((mantissa.x & 0x3FFFFFu) != 0u);
    int exponent = exponent_of(words) - 896;
    return FLOAT_OF(exponent < 1 ? 0u : round_float(words.y & 0x80000000u, exponent, kept.x | lost));
}

// Of a whole number of 64 bits, two's complement, within +-2^62.
DOUBLE double_of_signed(uvec2 whole)
{
    bool below = whole.y >> 31 == 1u;
    uvec2 size = double_of(below ? sub64(uvec2(0u), whole) : whole);
    return DOUBLE_OF(below ? negative(size) : size);
}
