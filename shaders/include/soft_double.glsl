// IEEE 754 double precision in whole numbers, to nearest even: OpenGL has doubles, but neither their division nor their
// square root is promised to the last bit, and many cards have few units for them. A double is its bits, uvec2(low, high).
// No infinities: ours do not become so large. What a product has below 2^-1022 is zero.
#include "words64.glsl"

const uvec2 ZERO = uvec2(0u), ONE = uvec2(0u, 0x3FF00000u), HALF = uvec2(0u, 0x3FE00000u);

int exponent_of(uvec2 a)
{
    return int((a.y >> 20) & 0x7FFu);
}

uvec2 mantissa_of(uvec2 a)
{
    return uvec2(a.x, (a.y & 0xFFFFFu) | 0x100000u);
}

uvec2 negative(uvec2 a)
{
    return uvec2(a.x, a.y ^ 0x80000000u);
}

// a 2^n, where neither end is zero or infinite.
uvec2 scaled(uvec2 a, int n)
{
    return uvec2(a.x, a.y + (uint(n) << 20));
}

// sign | 1.mantissa 2^(exponent - 1023) of a mantissa of 63 bits (the first one set), ten of which are rounded away.
uvec2 round_double(uint sign, int exponent, uvec2 mantissa)
{
    uvec2 kept = right64(mantissa, 10u);
    uint lost = mantissa.x & 0x3FFu;
    kept = add64(kept, uvec2(uint(lost > 0x200u || (lost == 0x200u && (kept.x & 1u) == 1u)), 0u));
    return add64(uvec2(0u, sign + (uint(exponent) << 20)), sub64(kept, uvec2(0u, 0x100000u)));
}

uvec2 mul_double(uvec2 a, uvec2 b)
{
    uint sign = (a.y ^ b.y) & 0x80000000u;
    int exponent = exponent_of(a) + exponent_of(b) - 1023;
    uvec2 m = left64(mantissa_of(a), 11u), n = left64(mantissa_of(b), 11u);
    // 64 x 64 bits: the upper half, and whether the lower one is zero.
    uvec2 low = mul64(m.x, n.x), cross_a = mul64(m.y, n.x), cross_b = mul64(m.x, n.y), high = mul64(m.y, n.y);
    uvec2 middle = add64(add64(uvec2(low.y, 0u), uvec2(cross_a.x, 0u)), uvec2(cross_b.x, 0u));
    high = add64(add64(high, uvec2(cross_a.y, 0u)), add64(uvec2(cross_b.y, 0u), uvec2(middle.y, 0u)));
    uint rest = low.x | middle.x;
    if ((high.y & 0x80000000u) != 0u) {
        rest |= high.x & 1u;
        high = right64(high, 1u);
        exponent += 1;
    }
    high.x |= uint(rest != 0u);
    bool zero = exponent_of(a) == 0 || exponent_of(b) == 0 || exponent < 1;
    return zero ? uvec2(0u, sign) : round_double(sign, exponent, high);
}

uvec2 add_double(uvec2 a, uvec2 b)
{
    uvec2 size_a = uvec2(a.x, a.y & 0x7FFFFFFFu), size_b = uvec2(b.x, b.y & 0x7FFFFFFFu);
    if (!at_least64(size_a, size_b)) {
        uvec2 t = a;
        a = b;
        b = t;
    }
    int exponent = exponent_of(a), apart = exponent - exponent_of(b);
    uvec2 larger = left64(mantissa_of(a), 10u), smaller = left64(mantissa_of(b), 10u);
    // What is shifted out leaves a mark in the last bit.
    uvec2 kept = apart > 63 ? ZERO : right64(smaller, uint(apart));
    kept.x |= uint(apart > 63 || left64(kept, uint(min(apart, 63))) != smaller);
    uvec2 sum = ((a.y ^ b.y) & 0x80000000u) == 0u ? add64(larger, kept) : sub64(larger, kept);
    if (exponent_of(b) == 0) {
        return a;
    }
    if (sum == ZERO) {
        return ZERO;
    }
    int shift = 62 - msb64(sum);
    sum = shift < 0 ? right64(sum, 1u) | uvec2(sum.x & 1u, 0u) : left64(sum, uint(shift));
    return round_double(a.y & 0x80000000u, exponent - shift, sum);
}

// a / b, a may be zero. Bit by bit: 55 of the quotient, and whether anything is left.
uvec2 div_double(uvec2 a, uvec2 b)
{
    if (exponent_of(a) == 0) {
        return ZERO;
    }
    uvec2 rest = mantissa_of(a), divisor = mantissa_of(b), quotient = ZERO;
    int exponent = exponent_of(a) - exponent_of(b) + 1023;
    if (!at_least64(rest, divisor)) {
        rest = left64(rest, 1u);
        exponent -= 1;
    }
    for (int k = 0; k < 55; ++k) {
        bool fits = at_least64(rest, divisor);
        quotient = left64(quotient, 1u);
        quotient.x |= uint(fits);
        rest = left64(fits ? sub64(rest, divisor) : rest, 1u);
    }
    quotient = left64(quotient, 8u); // from 55 bits to 63
    quotient.x |= uint(rest != ZERO);
    return round_double((a.y ^ b.y) & 0x80000000u, exponent, quotient);
}

// Of a number above zero, digit by digit.
uvec2 sqrt_double(uvec2 a)
{
    int exponent = exponent_of(a) - 1023;
    // The mantissa as a number of 54 or 53 bits, below it zeros: two bits of it a digit of the root.
    uvec2 digits = left64(mantissa_of(a), (exponent & 1) == 0 ? 10u : 11u);
    uvec2 root = ZERO, rest = ZERO;
    for (int k = 0; k < 55; ++k) {
        rest = left64(rest, 2u);
        rest.x |= digits.y >> 30;
        digits = left64(digits, 2u);
        uvec2 trial = left64(root, 2u);
        trial.x |= 1u;
        bool fits = at_least64(rest, trial);
        rest = fits ? sub64(rest, trial) : rest;
        root = left64(root, 1u);
        root.x |= uint(fits);
    }
    root = left64(root, 8u);
    root.x |= uint(rest != ZERO);
    return round_double(0u, (exponent >> 1) + 1023, root);
}

uvec2 double_of(uvec2 whole) // unsigned, below 2^63
{
    if (whole == ZERO) {
        return ZERO;
    }
    int top = msb64(whole);
    return round_double(0u, top + 1023, left64(whole, uint(62 - top)));
}

uvec2 double_of(int whole)
{
    uvec2 size = double_of(uvec2(uint(abs(whole)), 0u));
    return whole < 0 ? negative(size) : size;
}

// Rounded towards zero, of a number >= 0 and below 2^63.
uvec2 whole_of(uvec2 a)
{
    int shift = exponent_of(a) - 1075;
    uvec2 mantissa = mantissa_of(a);
    return shift < -52 ? ZERO : shift < 0 ? right64(mantissa, uint(-shift)) : left64(mantissa, uint(shift));
}

bool less_double(uvec2 a, uvec2 b)
{
    uvec2 size_a = uvec2(a.x, a.y & 0x7FFFFFFFu), size_b = uvec2(b.x, b.y & 0x7FFFFFFFu);
    bool below_a = a.y >> 31 == 1u, below_b = b.y >> 31 == 1u;
    if (below_a != below_b) {
        return below_a && (size_a != ZERO || size_b != ZERO);
    }
    return below_a ? !at_least64(size_b, size_a) : !at_least64(size_a, size_b);
}

int floor_of(uvec2 a) // of a number within +-2^31
{
    int exponent = exponent_of(a) - 1023;
    bool below = (a.y & 0x80000000u) != 0u;
    if (exponent < 0) {
        return below && exponent_of(a) != 0 ? -1 : 0;
    }
    uvec2 mantissa = mantissa_of(a), whole = right64(mantissa, uint(52 - exponent));
    bool fraction = left64(whole, uint(52 - exponent)) != mantissa;
    return below ? -int(whole.x) - int(fraction) : int(whole.x);
}
