// Random numbers of (seed, pixel, stream, index), uniform and normal: blinkgl/events/philox.py, bit for bit.
#include "arith.glsl"
#include "doubles.glsl"
#define COEFFICIENT(K) DOUBLE_OF(DOUBLES[K])
#define ONE_DOUBLE DOUBLE_OF(ONE)
#define HALF_DOUBLE DOUBLE_OF(HALF)

// c[0] + z (c[1] + ... z c[count - 1]), of the coefficients from `first` on.
DOUBLE polynomial(DOUBLE z, int first, int count)
{
    DOUBLE p = COEFFICIENT(first + count - 1);
    for (int k = count - 2; k >= 0; --k) {
        p = add_double(mul_double(z, p), COEFFICIENT(first + k));
    }
    return p;
}

uvec4 philox4x32(uvec4 counter, uvec2 key)
{
    for (int k = 0; k < 10; ++k) {
        uint high_x, low_x, high_z, low_z;
        umulExtended(counter.x, 0xD2511F53u, high_x, low_x);
        umulExtended(counter.z, 0xCD9E8D57u, high_z, low_z);
        counter = uvec4(high_z ^ counter.y ^ key.x, low_z, high_x ^ counter.w ^ key.y, low_x);
        key += uvec2(0x9E3779B9u, 0xBB67AE85u);
    }
    return counter;
}

// Uniform in (0, 1) of the upper 53 of 64 bits.
DOUBLE uniform_of(uvec2 bits)
{
    return scaled(add_double(DOUBLE_OF(double_of(right64(bits, 11u))), HALF_DOUBLE), -53);
}

DOUBLE log_double(DOUBLE number)
{
    uvec2 v = WORDS_OF(number);
    int exponent = int(sub64(v, DOUBLES[SQRT_HALF]).y) >> 20;
    DOUBLE m = DOUBLE_OF(uvec2(v.x, v.y - (uint(exponent) << 20)));
    DOUBLE s = div_double(sub_double(m, ONE_DOUBLE), add_double(m, ONE_DOUBLE)), z = mul_double(s, s);
    DOUBLE p = polynomial(z, LOG_FIRST, LOG_COUNT);
    DOUBLE reduced = add_double(add_double(s, s), mul_double(mul_double(s, z), p));
    return add_double(mul_double(DOUBLE_OF(double_of(exponent)), COEFFICIENT(LN2)), reduced);
}

// Two of them.
void normal2(uvec2 seed, uint pixel, uint stream, uint index, out DOUBLE first, out DOUBLE second)
{
    uvec4 words = philox4x32(uvec4(pixel, stream, index, 0u), seed);
    DOUBLE logarithm = log_double(uniform_of(words.xy));
    DOUBLE radius = is_zero(logarithm) ? logarithm : sqrt_double(negative(add_double(logarithm, logarithm)));
    uvec2 turns = WORDS_OF(scaled(uniform_of(words.zw), 2));
    int nearest = floor_of(turns);
    DOUBLE f = sub_double(DOUBLE_OF(turns), DOUBLE_OF(double_of(nearest)));
    // To the nearest whole number, to the even one where both are: as adding 1.5 2^52 and taking it off.
    bool tie = WORDS_OF(f) == HALF, above = !less_double(f, HALF_DOUBLE) && (!tie || (nearest & 1) == 1);
    nearest += int(above);
    if (above) {
        f = sub_double(f, ONE_DOUBLE);
    }
    DOUBLE z = mul_double(f, f);
    DOUBLE s = mul_double(polynomial(z, SIN_FIRST, SIN_COUNT), f), c = polynomial(z, COS_FIRST, COS_COUNT);
    bool odd = (nearest & 1) == 1;
    DOUBLE cosine = odd ? s : c, sine = odd ? c : s;
    cosine = ((nearest + 1) & 2) != 0 ? negative(cosine) : cosine;
    sine = (nearest & 2) != 0 ? negative(sine) : sine;
    first = mul_double(radius, cosine);
    second = mul_double(radius, sine);
}
