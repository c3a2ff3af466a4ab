// V2E's pixels that have met a level or have noise, one an invocation (blinkgl/events/v2e_waves.py, pixel by pixel).
// Without EMIT: how many events each has.   With EMIT: the same again, which writes events and what becomes of the pixel;
// where the buffer is too small for them nothing is written, and it is run again with a larger one.
// LOW_PASS, LEAKS, LEAK_JITTER, SHOTS, HUMS, DEAD_TIME, CAUSES: what the configuration asks for.
#include "events.glsl"
#include "v2e.glsl"
#include "v2e_tiles.glsl"
layout(local_size_x = 256) in;

layout(std430, binding = 0) restrict buffer Listed { Head head; uvec2 listed[]; };
layout(std430, binding = 1) restrict buffer Counts { uint counts[]; };
#ifdef BATCH
layout(std430, binding = 2) readonly restrict buffer Both { uint both[]; };
uniform uint cuts_at; // in Counts: where the tiles' cut events are counted
#else
layout(std430, binding = 2) readonly restrict buffer Now { uint now[]; };
layout(std430, binding = 3) readonly restrict buffer Before { uint before[]; };
#endif
layout(std430, binding = 4) restrict buffer State { uint state[]; };
#ifdef SHOTS
layout(std430, binding = 5) readonly restrict buffer Shots { uvec4 shots[]; };
uniform uint room;
#endif
#ifdef EMIT
layout(std430, binding = 6) readonly restrict buffer Offsets { uint offsets[]; };
layout(std430, binding = 7) writeonly restrict buffer Packed { uvec2 packed_events[]; };
uniform uint capacity;
#endif
uniform uint padded;
uniform uint width;
#define BEFORE(PLANE) widened(FLOAT_OF(BEFORE_AT(PLANE * padded + pixel)))
#define NOW(PLANE) widened(FLOAT_OF(NOW_AT(PLANE * padded + pixel)))
#define STATE(PLANE) widened(FLOAT_OF(state[PLANE * padded + pixel]))
#define TIME(PLANE) uvec2(state[PLANE * padded + pixel], state[(PLANE + 1u) * padded + pixel])
#define DOUBLE_ZERO DOUBLE_OF(ZERO)
const uint NONE = 0xFFFFFFFFu;

uvec2 t_ns(uvec2 after) // of the clock that frames are stamped with
{
    return add64(start, after);
}

#ifdef LEAK_JITTER
DOUBLE rough_normal(uint pixel, uvec2 index)
{
    uvec4 w = philox4x32(uvec4(pixel, LEAK_JITTER_STREAM, index), seed);
    uvec2 sum = add64(add64(uvec2(w.x, 0u), uvec2(w.y, 0u)), add64(uvec2(w.z, 0u), uvec2(w.w, 0u)));
    DOUBLE mean = sum == uvec2(0u) ? DOUBLE_ZERO : scaled(DOUBLE_OF(double_of(sum)), -32);
    return mul_double(sub_double(mean, D_MEAN_OF_FOUR), D_THREE_ROOT);
}
#endif

#ifdef CAUSES
// Of a crossing: the largest part of what moved the pixel, all in its direction (blinkgl/events/packing.py, cause_of).
uint cause_of(DOUBLE light, DOUBLE leak, DOUBLE noise)
{
    if (!less_double(light, leak) && !less_double(light, noise)) {
        return 0u;
    }
    return less_double(leak, noise) ? 2u : 1u;
}
#endif

void main()
{
    uint k = gl_GlobalInvocationID.x;
    if (k >= head.pixels) {
#ifndef EMIT
        counts[k] = 0u; // up to the end of the last chunk
#endif
        return;
    }
#ifdef EMIT
    if (head.events > capacity) {
        return;
    }
    uint at = offsets[k];
#endif
    uint pixel = listed[k].x, limit = listed[k].y, alive = 0u, own = pixel, row = 0u; // in its picture; its first row
#ifdef BATCH
    uint tile = enter(own);
    row = tile * height;
#endif
    uvec2 after = uvec2(0u);
#ifdef DEAD_TIME
    bool asleep = state[UPPER * padded + pixel] == 0xFF800000u;
    if (asleep) {
        after = sub64(TIME(RELEASE), start);
        after = int(after.y) < 0 ? uvec2(0u) : after;
        if (!at_least64(dt_ns, after)) {
#ifndef EMIT
            counts[k] = 0u;
#endif
            return;
        }
    }
#endif
    Curve z;
    DOUBLE x = BEFORE(X), dx = sub_double(NOW(X), x), base = x, drift = DOUBLE_ZERO, leak = DOUBLE_ZERO;
#ifdef HUMS
    DOUBLE hum = BEFORE(NOISE), hums = sub_double(NOW(NOISE), hum);
    base = add_double(base, hum);
    drift = hums;
#endif
#ifdef LEAKS
    leak = STATE(LEAK);
    base = add_double(base, mul_double(leak, DOUBLE_OF(since_0)));
    drift = add_double(drift, mul_double(leak, DOUBLE_OF(dt_s)));
#endif
    z.c = base;
    z.rise = add_double(drift, dx);
    z.end = add_double(add_double(base, drift), dx);
#ifdef LOW_PASS
    DOUBLE mean = mul_double(HALF_DOUBLE, add_double(BEFORE(LIGHT), NOW(LIGHT)));
    z.k = mul_double(DOUBLE_OF(kappa_double), add_double(mean, D_TWENTY));
    DOUBLE behind = div_double(dx, z.k);
    z.end = add_double(z.end, NOW(LAG));
    z.c = sub_double(base, behind);
    z.fall = add_double(BEFORE(LAG), behind);
#else
    z.k = z.fall = DOUBLE_ZERO;
#endif
    DOUBLE on = STATE(ON), off = STATE(OFF), up = STATE(UPPER), down = STATE(LOWER), s = DOUBLE_ZERO;
#ifdef CAUSES
    uvec2 origin = sub64(TIME(SINCE), start);
#ifdef HUMS
    DOUBLE hum_then = STATE(NOISE_THEN);
#endif
#endif
#ifdef DEAD_TIME
    if (asleep) { // it wakes, and looks from there
        s = div_double(DOUBLE_OF(double_of(after)), DOUBLE_OF(dt_whole));
        DOUBLE reference = signal_at(z, s);
        up = add_double(reference, on);
        down = sub_double(reference, off);
#ifdef CAUSES
        origin = after;
#ifdef HUMS
        hum_then = add_double(hum, mul_double(hums, s));
#endif
#endif
    }
#endif
#ifdef SHOTS
    uint shots_at = (room + 1u) * (pixel / 1024u) + 1u, shot = NOW_AT(FIRST_SHOT * padded + pixel);
#endif
    uint line = own / width, y = line + row, word = (y << 17) | ((own - line * width) << 1), upper_word = y >> 15;
    bool dead = false;
    for (;;) {
        bool above = !less_double(z.end, up), fires = above || !less_double(down, z.end), positive = above, by_noise = false;
        DOUBLE level = above ? up : down;
        uvec2 at_ns = uvec2(0u);
        if (fires) {
            s = crossing(z, s, level, above);
            at_ns = nanoseconds(mul_double(s, DOUBLE_OF(dt_whole)));
        }
#ifdef SHOTS
        uvec4 next = uvec4(0u);
        uvec2 shot_ns = uvec2(0u);
        while (shot != NONE) { // those of its dead time are lost
            next = shots[shots_at + shot];
            shot_ns = right64(next.xy, 1u);
            if (at_least64(shot_ns, after)) {
                break;
            }
            shot = next.z;
        }
        if (shot != NONE && (!fires || at_least64(at_ns, shot_ns))) {
            fires = by_noise = true;
            positive = (next.x & 1u) == 1u;
            at_ns = shot_ns;
            s = div_double(DOUBLE_OF(double_of(shot_ns)), DOUBLE_OF(dt_whole));
            shot = next.z;
        }
#endif
        if (!fires) {
            break;
        }
#ifdef EMIT
        if (alive < limit) {
            uint rest, us = divide64(add64(at_ns, uvec2(start_ns, 0u)), 1000u, rest), cause = 0u;
#ifdef CAUSES
            if (by_noise) {
                cause = 2u;
            } else {
                DOUBLE moving = mul_double(double_of_signed(sub64(at_ns, origin)), D_NS), noise = DOUBLE_ZERO;
                DOUBLE by_leak = mul_double(signed_as(leak, above), moving);
#ifdef HUMS
                noise = signed_as(sub_double(add_double(hum, mul_double(hums, s)), hum_then), above);
#endif
                DOUBLE size = positive ? on : off;
                cause = cause_of(sub_double(sub_double(size, by_leak), noise), by_leak, noise);
#ifdef HOT
                cause = cause == 1u && state[HOT * padded + pixel] != 0u ? 3u : cause;
#endif
            }
#endif
            packed_events[at] = uvec2(word | uint(positive) | (cause << 31), (us << 1) | upper_word | (cause >> 1));
            at += 1u;
        }
#endif
        alive += 1u;
#ifdef LEAK_JITTER
        DOUBLE spread = mul_double(DOUBLE_OF(leak_jitter), rough_normal(own, t_ns(at_ns)));
        spread = add_double(ONE_DOUBLE, spread);
        if (!less_double(D_TENTH, spread)) {
            spread = D_TENTH;
        }
        DOUBLE change = sub_double(widened(narrowed(div_double(STATE(MEAN_LEAK), spread))), leak);
        leak = add_double(leak, change);
        level = add_double(level, mul_double(change, add_double(DOUBLE_OF(since_0), mul_double(s, DOUBLE_OF(dt_s)))));
        z.c = add_double(z.c, mul_double(change, DOUBLE_OF(since_0)));
        z.rise = add_double(z.rise, mul_double(change, DOUBLE_OF(dt_s)));
        z.end = add_double(z.end, mul_double(change, DOUBLE_OF(since_1)));
#endif
#ifdef DEAD_TIME
        after = add64(at_ns, refractory_ns);
        dead = !at_least64(dt_ns, after);
        if (dead) {
            break;
        }
        s = div_double(DOUBLE_OF(double_of(after)), DOUBLE_OF(dt_whole));
        level = signal_at(z, s);
#else
        after = at_ns;
        if (by_noise) { // which leaves the reference wherever the signal is
            level = signal_at(z, s);
        }
#endif
        up = add_double(level, on);
        down = sub_double(level, off);
#ifdef CAUSES
        origin = after;
#ifdef HUMS
        hum_then = add_double(hum, mul_double(hums, s));
#endif
#endif
    }
#ifdef EMIT
    state[UPPER * padded + pixel] = dead ? 0xFF800000u : BITS_OF(narrowed(up));
    state[LOWER * padded + pixel] = dead ? 0x7F800000u : BITS_OF(narrowed(down));
#ifdef LEAK_JITTER
    state[LEAK * padded + pixel] = BITS_OF(narrowed(leak));
#endif
#ifdef DEAD_TIME
    if (dead) {
        uvec2 release = t_ns(after);
        state[RELEASE * padded + pixel] = release.x;
        state[(RELEASE + 1u) * padded + pixel] = release.y;
    }
#endif
#ifdef CAUSES
    uvec2 then = t_ns(origin);
    state[SINCE * padded + pixel] = then.x;
    state[(SINCE + 1u) * padded + pixel] = then.y;
#ifdef HUMS
    state[NOISE_THEN * padded + pixel] = BITS_OF(narrowed(hum_then));
#endif
#endif
#else
    counts[k] = min(alive, limit);
    if (alive > limit) {
        atomicAdd(head.cut, alive - limit);
#ifdef BATCH
        atomicAdd(counts[cuts_at + tile], alive - limit);
#endif
    }
#endif
}
