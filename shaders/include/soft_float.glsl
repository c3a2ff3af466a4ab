// IEEE 754 single precision in whole numbers, to nearest even, for cards whose own rounding is not that. A float is its
// bits, a uint. No infinities: ours do not become so large. What is smaller than 2^-126 is zero.
#include "words64.glsl"

// sign | 1.mantissa 2^(exponent - 127) of a mantissa of 31 bits (the first one set), seven of which are rounded away.
uint round_float(uint sign, int exponent, uint mantissa)
{
    uint kept = mantissa >> 7, lost = mantissa & 0x7Fu;
    kept += uint(lost > 0x40u || (lost == 0x40u && (kept & 1u) == 1u));
    return sign + (uint(exponent) << 23) + (kept - 0x800000u); // a carry goes on into the exponent
}

uint mul_float(uint a, uint b)
{
    uint sign = (a ^ b) & 0x80000000u;
    int exponent = int((a >> 23) & 0xFFu) + int((b >> 23) & 0xFFu) - 127;
    uint high, low;
    umulExtended(((a & 0x7FFFFFu) | 0x800000u) << 8, ((b & 0x7FFFFFu) | 0x800000u) << 8, high, low);
    if ((high & 0x80000000u) != 0u) {
        low = (low >> 1) | (high << 31) | (low & 1u);
        high >>= 1;
        exponent += 1;
    }
    bool zero = ((a >> 23) & 0xFFu) == 0u || ((b >> 23) & 0xFFu) == 0u || exponent < 1;
    return zero ? sign : round_float(sign, exponent, high | uint(low != 0u));
}

uint add_float(uint a, uint b)
{
    if ((a & 0x7FFFFFFFu) < (b & 0x7FFFFFFFu)) {
        uint t = a;
        a = b;
        b = t;
    }
    int exponent = int((a >> 23) & 0xFFu);
    uint apart = uint(exponent) - ((b >> 23) & 0xFFu);
    uint larger = ((a & 0x7FFFFFu) | 0x800000u) << 7, smaller = ((b & 0x7FFFFFu) | 0x800000u) << 7;
    // What is shifted out leaves a mark in the last bit.
    smaller = apart > 31u ? 1u : (smaller >> apart) | uint((smaller & ((1u << apart) - 1u)) != 0u);
    uint sum = ((a ^ b) & 0x80000000u) == 0u ? larger + smaller : larger - smaller;
    if (((b >> 23) & 0xFFu) == 0u) {
        return a;
    }
    if (sum == 0u) {
        return 0u;
    }
    int shift = 30 - findMSB(sum);
    sum = shift < 0 ? (sum >> 1) | (sum & 1u) : sum << uint(shift);
    return exponent - shift < 1 ? 0u : round_float(a & 0x80000000u, exponent - shift, sum);
}

// a / b, b not zero; an infinity where the quotient is too large.
uint div_float(uint a, uint b)
{
    uint sign = (a ^ b) & 0x80000000u, m = (a & 0x7FFFFFu) | 0x800000u, n = (b & 0x7FFFFFu) | 0x800000u, rest;
    int exponent = int((a >> 23) & 0xFFu) - int((b >> 23) & 0xFFu) + 127;
    if (m < n) {
        m <<= 1;
        exponent -= 1;
    }
    uint mantissa = divide64(left64(uvec2(m, 0u), 30u), n, rest); // 31 bits, the first one set
    if (((a >> 23) & 0xFFu) == 0u || exponent < 1) {
        return sign;
    }
    return exponent > 254 ? sign | 0x7F800000u : round_float(sign, exponent, mantissa | uint(rest != 0u));
}

// Of a number >= 0, digit by digit.
uint sqrt_float(uint a)
{
    int exponent = int(a >> 23) - 127;
    uvec2 digits = left64(uvec2((a & 0x7FFFFFu) | 0x800000u, 0u), (exponent & 1) == 0 ? 39u : 40u);
    uint root = 0u, rest = 0u;
    for (int k = 0; k < 26; ++k) {
        rest = (rest << 2) | (digits.y >> 30);
        digits = left64(digits, 2u);
        uint trial = (root << 2) | 1u;
        bool fits = rest >= trial;
        rest = fits ? rest - trial : rest;
        root = (root << 1) | uint(fits);
    }
    return (a >> 23) == 0u ? 0u : round_float(0u, (exponent >> 1) + 127, (root << 5) | uint(rest != 0u));
}

// Rounded towards zero, of a number below 2^24.
int whole_of_float(uint a)
{
    int exponent = int((a >> 23) & 0xFFu);
    int magnitude = exponent < 127 ? 0 : int(((a & 0x7FFFFFu) | 0x800000u) >> uint(150 - exponent));
    return (a & 0x80000000u) != 0u ? -magnitude : magnitude;
}
