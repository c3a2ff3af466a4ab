// The elements of V2E (blinkgl/events/v2e_model.py and arith.py), operation for operation.
#include "normal.glsl"
#include "v2e_numbers.glsl"

// --- single precision: the photoreceptor ---

FLOAT log_float(FLOAT v) // log_f32
{
    int bits = int(BITS_OF(v)), exponent = (bits - int(SQRT_HALF_BITS)) >> 23;
    FLOAT f = sub_float(FLOAT_OF(uint(bits - (exponent << 23))), F_ONE);
    FLOAT p = FLOAT_OF(LOG1P_BITS[8]);
    for (int k = 7; k >= 0; --k) {
        p = add_float(mul_float(p, f), FLOAT_OF(LOG1P_BITS[k]));
    }
    FLOAT reduced = add_float(f, mul_float(mul_float(f, f), p));
    return add_float(mul_float(float_of(exponent), F_LN2_32), reduced);
}

FLOAT lin_log(FLOAT light)
{
    if (less_float(light, F_DARK)) {
        return F_ZERO;
    }
    return less_float(F_JOINT, light) ? log_float(light) : mul_float(light, F_SLOPE);
}

FLOAT growth(FLOAT k) // (1 - e^-k)/k for k < 1/2
{
    FLOAT p = FLOAT_OF(GROWTH_BITS[6]);
    for (int n = 5; n >= 0; --n) {
        p = add_float(mul_float(p, k), FLOAT_OF(GROWTH_BITS[n]));
    }
    return p;
}

FLOAT exp_float(FLOAT v) // exp_f32, v <= 0
{
    v = less_float(v, F_EXP_MIN_32) ? F_EXP_MIN_32 : v;
    FLOAT rounded = add_float(mul_float(v, F_LOG2E_32), F_ROUND_32), n = sub_float(rounded, F_ROUND_32);
    FLOAT r = sub_float(sub_float(v, mul_float(n, F_LN2_HI_32)), mul_float(n, F_LN2_LO_32));
    FLOAT p = FLOAT_OF(EXP_BITS[6]);
    for (int k = 5; k >= 0; --k) {
        p = add_float(mul_float(p, r), FLOAT_OF(EXP_BITS[k]));
    }
    int whole = int(BITS_OF(rounded)) - int(BITS_OF(F_ROUND_32)); // of one binade: a step of the bits is one
    return mul_float(p, FLOAT_OF(uint(whole + 127) << 23));
}

// (e^-k, (1 - e^-k)/k)
void decay(FLOAT k, out FLOAT keep, out FLOAT ramp)
{
    if (less_float(k, F_HALF)) {
        ramp = growth(k);
        keep = sub_float(F_ONE, mul_float(k, ramp));
    } else {
        keep = exp_float(negative_float(k));
        ramp = div_float(sub_float(F_ONE, keep), k);
    }
}

FLOAT settled(FLOAT lag)
{
    return less_float(FLOAT_OF(BITS_OF(lag) & 0x7FFFFFFFu), F_SETTLED) ? F_ZERO : lag;
}

// What a low-pass is behind at the interval's end.
FLOAT lag_of(FLOAT lag, FLOAT before, FLOAT now, FLOAT keep, FLOAT ramp)
{
    return settled(sub_float(mul_float(lag, keep), mul_float(sub_float(now, before), ramp)));
}

// --- double precision: when the signal meets a level ---

DOUBLE fall_double(DOUBLE x) // fall_f64, x >= 0
{
    DOUBLE v = negative(x);
    if (less_double(v, D_FALL_MIN_64)) {
        v = D_FALL_MIN_64;
    }
    DOUBLE t = D_ROUND_64;
    if (less_double(HALF_DOUBLE, x)) {
        t = add_double(mul_double(v, D_LOG2E_64), D_ROUND_64);
    }
    DOUBLE n = sub_double(t, D_ROUND_64);
    DOUBLE r = sub_double(sub_double(v, mul_double(n, D_LN2_HI_64)), mul_double(n, D_LN2_LO_64));
    DOUBLE r2 = mul_double(r, r), r4 = mul_double(r2, r2), part[3];
    for (int k = 0; k < 3; ++k) {
        DOUBLE a = add_double(DOUBLE_OF(FALL_WORDS[4 * k]), mul_double(DOUBLE_OF(FALL_WORDS[4 * k + 1]), r));
        DOUBLE b = add_double(DOUBLE_OF(FALL_WORDS[4 * k + 2]), mul_double(DOUBLE_OF(FALL_WORDS[4 * k + 3]), r));
        part[k] = add_double(a, mul_double(r2, b));
    }
    DOUBLE high = add_double(part[2], mul_double(r4, DOUBLE_OF(FALL_WORDS[12])));
    DOUBLE p = add_double(part[0], mul_double(r4, add_double(part[1], mul_double(r4, high))));
    return mul_double(p, DOUBLE_OF(uvec2(0u, (WORDS_OF(t).x + 1023u) << 20)));
}

// z(s) = c + rise s + fall e^(-k s), `end` at s = 1. Without LOW_PASS a straight line.
struct Curve {
    DOUBLE c, rise, fall, k, end;
};

DOUBLE signal_at(Curve z, DOUBLE s)
{
    DOUBLE line = add_double(z.c, mul_double(z.rise, s));
#ifdef LOW_PASS
    return add_double(line, mul_double(z.fall, fall_double(mul_double(z.k, s))));
#else
    return line;
#endif
}

DOUBLE signed_as(DOUBLE a, bool positive)
{
    return positive ? a : negative(a);
}

#ifdef LOW_PASS
// crossing_fraction: where in [start, 1] z is `target`.
DOUBLE crossing(Curve z, DOUBLE start, DOUBLE target, bool up)
{
    DOUBLE e_low = fall_double(mul_double(z.k, start));
    DOUBLE line = add_double(z.c, mul_double(z.rise, start));
    DOUBLE f_low = signed_as(sub_double(add_double(line, mul_double(z.fall, e_low)), target), up);
    if (!less_double(f_low, DOUBLE_OF(ZERO))) {
        return start;
    }
    DOUBLE low = start, high = ONE_DOUBLE, f_high = signed_as(sub_double(z.end, target), up);
    DOUBLE v_low = signed_as(sub_double(z.rise, mul_double(mul_double(z.k, z.fall), e_low)), up);
    DOUBLE left = sub_double(sub_double(z.end, z.c), z.rise);
    DOUBLE v_high = signed_as(sub_double(z.rise, mul_double(z.k, left)), up);
    DOUBLE width = sub_double(high, low), height = sub_double(f_high, f_low);
    DOUBLE u = div_double(negative(f_low), height);
    DOUBLE s = add_double(low, mul_double(width, u));
    DOUBLE area = mul_double(mul_double(width, v_low), v_high);
    if (less_double(DOUBLE_OF(ZERO), v_low) && less_double(DOUBLE_OF(ZERO), v_high) && !is_zero(area)) {
        DOUBLE stretch = div_double(height, area), rest = sub_double(ONE_DOUBLE, u);
        DOUBLE slopes = sub_double(mul_double(rest, v_high), mul_double(u, v_low));
        DOUBLE chord = mul_double(u, sub_double(D_THREE, mul_double(D_TWO, u)));
        DOUBLE guess = mul_double(u, add_double(mul_double(mul_double(rest, stretch), slopes), chord));
        if (less_double(DOUBLE_OF(ZERO), guess) && less_double(guess, ONE_DOUBLE)) {
            s = add_double(low, mul_double(width, guess));
        }
    }
    for (int turn = 0; turn < 60; ++turn) {
        DOUBLE e = mul_double(z.fall, fall_double(mul_double(z.k, s)));
        line = add_double(z.c, mul_double(z.rise, s));
        DOUBLE f = signed_as(sub_double(add_double(line, e), target), up);
        if (less_double(f, DOUBLE_OF(ZERO))) {
            low = s;
        } else {
            high = s;
        }
        DOUBLE slope = signed_as(sub_double(z.rise, mul_double(z.k, e)), up), following = s;
        bool newton = less_double(DOUBLE_OF(ZERO), slope);
        if (newton) {
            following = sub_double(s, div_double(f, slope));
            newton = !less_double(following, low) && !less_double(high, following);
        }
        if (!newton) {
            following = mul_double(HALF_DOUBLE, add_double(low, high));
        }
        DOUBLE moved = sub_double(following, s);
        moved = DOUBLE_OF(WORDS_OF(moved) & uvec2(0xFFFFFFFFu, 0x7FFFFFFFu));
        s = following;
        if (less_double(moved, D_CLOSEST)) {
            break;
        }
        DOUBLE size = DOUBLE_OF(WORDS_OF(e) & uvec2(0xFFFFFFFFu, 0x7FFFFFFFu));
        DOUBLE error = mul_double(mul_double(mul_double(mul_double(moved, moved), z.k), z.k), size);
        if (newton && !less_double(mul_double(D_CLOSE, slope), error)) {
            break;
        }
    }
    return s;
}
#else
// The same on a straight line; `start` where it stands on the level.
DOUBLE crossing(Curve z, DOUBLE start, DOUBLE target, bool up)
{
    DOUBLE way = sub_double(target, z.c), s = start;
    if (is_zero(z.rise)) {
        return less_double(DOUBLE_OF(ZERO), way) ? ONE_DOUBLE : start;
    }
    s = div_double(way, z.rise);
    s = less_double(start, s) ? s : start;
    return less_double(s, ONE_DOUBLE) ? s : ONE_DOUBLE;
}
#endif

// Whole numbers, nanoseconds below 2^62, towards zero.
uvec2 nanoseconds(DOUBLE a)
{
    return whole_of(WORDS_OF(a));
}
