// V2E: what each pixel's photoreceptor holds at the frame, and whether its comparator has met a level (a bit each).
// LOW_PASS, SECOND, LEAKS, HUMS (photoreceptor noise): what the configuration asks for.   CHECKED: looks for values that
// cannot be used.   The planes of Now (of which the frame is one),
// Before and State are numbered by blinkgl/card/v2e.py.
#include "events.glsl"
#include "v2e.glsl"
#include "v2e_tiles.glsl"
layout(local_size_x = 256) in;

#ifdef BATCH
layout(std430, binding = 1) restrict buffer Both { uint both[]; };
#else
layout(std430, binding = 1) restrict buffer Now { uint now[]; };
layout(std430, binding = 2) readonly restrict buffer Before { uint before[]; };
#endif
layout(std430, binding = 3) readonly restrict buffer State { uint state[]; };
layout(std430, binding = 4) restrict buffer Marks { uint marks[]; };
layout(std430, binding = 5) restrict buffer Farthest { uint farthest[]; };
layout(std430, binding = 6) restrict buffer Heads { Head head; };
#ifdef HUMS
layout(std430, binding = 7) readonly restrict buffer Sizes { uint sizes[]; };
#endif
uniform uint padded;
uniform uint pixels; // of a picture
uniform uint limit; // bits of the largest value; those of negative numbers, infinities and NaN are larger
#define BEFORE(PLANE) FLOAT_OF(BEFORE_AT(PLANE * padded + pixel))
#define STATE(PLANE) FLOAT_OF(state[PLANE * padded + pixel])
#define PUT(PLANE, VALUE) NOW_AT(PLANE * padded + pixel) = BITS_OF(VALUE)
const uint INFINITE = 0x7F800000u;

#ifdef HUMS
FLOAT next_noise(uint pixel, uint tile, FLOAT noise, FLOAT k)
{
    DOUBLE first, second;
    normal2(seed, pixel / 2u, NOISE_STREAM, number, first, second); // two pixels share a draw
    FLOAT normal = narrowed((pixel & 1u) == 0u ? first : second);
    FLOAT least = less_float(k, F_SMALLEST_K) ? F_SMALLEST_K : k;
    FLOAT place = mul_float(sub_float(log_float(least), F_TABLE_LOW), F_TABLE_PER);
    place = less_float(F_TABLE_LAST, place) ? F_TABLE_LAST : place;
    int below = less_float(place, F_ZERO) ? 0 : whole_of_float(BITS_OF(place));
    FLOAT part = sub_float(place, float_of(below)), size = FLOAT_OF(sizes[256u * tile + uint(below)]), keep, ramp;
    size = add_float(size, mul_float(part, sub_float(FLOAT_OF(sizes[256u * tile + uint(below) + 1u]), size)));
    decay(k, keep, ramp);
    FLOAT fresh = sqrt_float(sub_float(F_ONE, mul_float(keep, keep)));
    return add_float(mul_float(noise, keep), mul_float(mul_float(size, fresh), normal));
}
#endif

void main()
{
    uint pixel = gl_GlobalInvocationID.x, own = pixel, tile = 0u; // in its picture
#ifdef BATCH
    if (pixel >= padded) {
        return;
    }
    tile = enter(own);
    if (here.fires == 0u) {
        return;
    }
#endif
    if (own >= pixels) {
        return;
    }
    uint seen = NOW_AT(FRAME * padded + pixel);
#ifdef CHECKED
    if (seen > limit && seen != 0x80000000u) {
        atomicOr(head.unusable, 1u);
    }
#endif
    FLOAT light = mul_float(FLOAT_OF(seen), FLOAT_OF(scale)), x = lin_log(light);
#ifdef LIGHT
    PUT(LIGHT, light);
#endif
#ifdef SECOND
    FLOAT lag_of_second = lag_of(BEFORE(SECOND_LAG), BEFORE(FIRST_X), x, FLOAT_OF(second_keep), FLOAT_OF(second_ramp));
    PUT(FIRST_X, x);
    PUT(SECOND_LAG, lag_of_second);
    x = add_float(x, lag_of_second);
#endif
    PUT(X, x);
    FLOAT z = x;
#ifdef LOW_PASS
    FLOAT mean = mul_float(F_HALF, add_float(BEFORE(LIGHT), light)), k = mul_float(FLOAT_OF(kappa), add_float(mean, F_JOINT));
    FLOAT keep, ramp;
    decay(k, keep, ramp);
    FLOAT lag = lag_of(BEFORE(LAG), BEFORE(X), x, keep, ramp);
    PUT(LAG, lag);
    z = add_float(z, lag);
#endif
#ifdef LEAKS
    z = add_float(z, mul_float(STATE(LEAK), FLOAT_OF(since)));
#endif
#ifdef HUMS
    FLOAT noise = next_noise(own, tile, BEFORE(NOISE), k);
    PUT(NOISE, noise);
    z = add_float(z, noise);
#endif
    // How far it is beyond a level; in its dead time (both are infinite) a pixel is looked at, too.
    uint beyond = INFINITE;
    if (state[UPPER * padded + pixel] != (INFINITE | 0x80000000u)) {
        FLOAT above = sub_float(z, STATE(UPPER)), below = sub_float(STATE(LOWER), z);
        above = less_float(below, above) ? above : below;
        beyond = BITS_OF(above);
        beyond = beyond == 0x80000000u ? 0u : beyond;
    }
    if (int(beyond) >= 0) {
        uint marked = atomicOr(marks[pixel / WORD], 1u << (pixel & 31u));
#ifdef SHOTS
        if ((marked >> (pixel & 31u) & 1u) == 0u) {
            NOW_AT(FIRST_SHOT * padded + pixel) = 0xFFFFFFFFu; // it has no noise
        }
#endif
        atomicMax(farthest[pixel / 1024u], beyond);
    }
}
