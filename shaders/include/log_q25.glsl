// ln(v) in 2^-25, v in [2^-30, 2^30]: log_q25 of blinkgl/events/arith.py, operation for operation. Its constants come from
// there (arith.glsl is no file). Only sums and products, each rounded to nearest even and none contracted: where a card
// says otherwise (blinkgl/card/proof.py asks), SOFT_FLOAT computes them in whole numbers.
#include "arith.glsl"
#ifdef SOFT_FLOAT
#include "soft_float.glsl"

int log_q25(uint v)
{
    int exponent = (int(v) - int(SQRT_HALF_BITS)) >> 23;
    uint f = add_float(uint(int(v) - (exponent << 23)), 0xBF800000u);
    uint p = add_float(mul_float(f, LOG_BITS[8]), LOG_BITS[7]);
    for (int k = 6; k >= 0; --k) {
        p = add_float(mul_float(p, f), LOG_BITS[k]);
    }
    uint r = add_float(f, mul_float(mul_float(f, f), p));
    return exponent * Q_LN2 + whole_of_float(mul_float(r, Q_SCALE_BITS));
}

// Of an intensity and what is added to it.
int log_of(float intensity, float eps)
{
    return log_q25(add_float(floatBitsToUint(intensity), floatBitsToUint(eps)));
}

ivec4 log_of(vec4 intensity, float eps)
{
    return ivec4(log_of(intensity.x, eps), log_of(intensity.y, eps), log_of(intensity.z, eps), log_of(intensity.w, eps));
}
#else
#define A(K) uintBitsToFloat(LOG_BITS[K])
#define LOG_OF(FLOAT, INT) \
    INT log_of(FLOAT intensity, float eps) \
    { \
        precise FLOAT v = intensity + eps; \
        INT bits = floatBitsToInt(v); \
        INT exponent = (bits - int(SQRT_HALF_BITS)) >> 23; \
        precise FLOAT f = intBitsToFloat(bits - (exponent << 23)) - 1.0; \
        precise FLOAT p = f * A(8) + A(7); \
        p = p * f + A(6); \
        p = p * f + A(5); \
        p = p * f + A(4); \
        p = p * f + A(3); \
        p = p * f + A(2); \
        p = p * f + A(1); \
        p = p * f + A(0); \
        precise FLOAT r = f + f * f * p; \
        return exponent * Q_LN2 + INT(r * uintBitsToFloat(Q_SCALE_BITS)); \
    }
LOG_OF(float, int)
LOG_OF(vec4, ivec4)
#endif
