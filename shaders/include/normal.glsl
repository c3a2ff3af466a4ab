// Standard normal numbers of (seed, pixel, stream, index): normal2 of blinkgl/events/philox.py, bit for bit.
#include "arith.glsl"
#include "soft_double.glsl"

// c[0] + z (c[1] + ... z c[count - 1]), of the coefficients from `first` on.
uvec2 polynomial(uvec2 z, int first, int count)
{
    uvec2 p = DOUBLES[first + count - 1];
    for (int k = count - 2; k >= 0; --k) {
        p = add_double(mul_double(z, p), DOUBLES[first + k]);
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
uvec2 uniform_of(uvec2 bits)
{
    return scaled(add_double(double_of(right64(bits, 11u)), HALF), -53);
}

uvec2 log_double(uvec2 v)
{
    int exponent = int(sub64(v, DOUBLES[SQRT_HALF]).y) >> 20;
    uvec2 m = uvec2(v.x, v.y - (uint(exponent) << 20));
    uvec2 s = div_double(add_double(m, negative(ONE)), add_double(m, ONE)), z = mul_double(s, s);
    uvec2 p = polynomial(z, LOG_FIRST, LOG_COUNT);
    uvec2 twice = exponent_of(s) == 0 ? ZERO : scaled(s, 1);
    uvec2 reduced = add_double(twice, mul_double(mul_double(s, z), p));
    return add_double(mul_double(double_of(exponent), DOUBLES[LN2]), reduced);
}

// Two of them, (low, high) each.
uvec4 normal2(uvec2 seed, uint pixel, uint stream, uint index)
{
    uvec4 words = philox4x32(uvec4(pixel, stream, index, 0u), seed);
    uvec2 logarithm = log_double(uniform_of(words.xy));
    uvec2 radius = exponent_of(logarithm) == 0 ? ZERO : sqrt_double(negative(scaled(logarithm, 1)));
    uvec2 turns = scaled(uniform_of(words.zw), 2);
    int nearest = floor_of(turns);
    uvec2 f = add_double(turns, negative(double_of(nearest)));
    // To the nearest whole number, to the even one where both are: as adding 1.5 2^52 and taking it off.
    bool above = at_least64(f, HALF) && (f != HALF || (nearest & 1) == 1);
    nearest += int(above);
    f = above ? add_double(f, negative(ONE)) : f;
    uvec2 z = mul_double(f, f);
    uvec2 s = mul_double(polynomial(z, SIN_FIRST, SIN_COUNT), f), c = polynomial(z, COS_FIRST, COS_COUNT);
    bool odd = (nearest & 1) == 1;
    uvec2 cosine = odd ? s : c, sine = odd ? c : s;
    cosine = ((nearest + 1) & 2) != 0 ? negative(cosine) : cosine;
    sine = (nearest & 2) != 0 ? negative(sine) : sine;
    return uvec4(mul_double(radius, cosine), mul_double(radius, sine));
}
