// 64-bit whole numbers as uvec2, x the low and y the high word, two's complement: OpenGL 4.3 has none of its own.

uvec2 add64(uvec2 a, uvec2 b)
{
    uint carry;
    uint low = uaddCarry(a.x, b.x, carry);
    return uvec2(low, a.y + b.y + carry);
}

uvec2 sub64(uvec2 a, uvec2 b)
{
    uint borrow;
    uint low = usubBorrow(a.x, b.x, borrow);
    return uvec2(low, a.y - b.y - borrow);
}

uvec2 mul64(uint a, uint b)
{
    uint high, low;
    umulExtended(a, b, high, low);
    return uvec2(low, high);
}

bool at_least64(uvec2 a, uvec2 b) // unsigned
{
    return a.y > b.y || (a.y == b.y && a.x >= b.x);
}

// a >> n and a << n for 0 <= n <= 63.
uvec2 right64(uvec2 a, uint n)
{
    if (n >= 32u) {
        return uvec2(a.y >> (n - 32u), 0u);
    }
    return n == 0u ? a : uvec2((a.x >> n) | (a.y << (32u - n)), a.y >> n);
}

uvec2 left64(uvec2 a, uint n)
{
    if (n >= 32u) {
        return uvec2(0u, a.x << (n - 32u));
    }
    return n == 0u ? a : uvec2(a.x << n, (a.y << n) | (a.x >> (32u - n)));
}

int msb64(uvec2 a) // of a > 0
{
    return a.y != 0u ? 32 + findMSB(a.y) : findMSB(a.x);
}

// a / b for b > 0 and a quotient below 2^32; the remainder goes to `rest`. Floats guess and whole numbers decide: a guess is
// taken a millionth too low, far more than any rounding of the vendor's division, so that what is left is never
// negative; what is left is divided again until it is less than b.
uint divide64(uvec2 a, uint b, out uint rest)
{
    const float TOO_LOW = 1.0 - 1e-6;
    float inverse = TOO_LOW / float(b);
    uint quotient = 0u;
    for (int turn = 0; turn < 8 && (a.y != 0u || a.x >= b); ++turn) { // two do; no input makes it turn for ever
        float guess = (float(a.y) * 4294967296.0 + float(a.x)) * inverse;
        uint part = max(uint(min(guess, 4294967040.0)), 1u);
        a = sub64(a, mul64(part, b));
        quotient += part;
    }
    rest = a.x;
    return quotient;
}
