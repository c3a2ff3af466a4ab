// ESIM's pixels that fire, one an invocation (Rebecq et al. 2018, section 3; blinkgl/events/esim.py is the same in numba).
// Without EMIT  : how many events each has, its next levels, and a record of what is needed to say their times.
// With EMIT     : the events, from records alone: where the buffer was too small it is run again with a larger one.
// SPREAD: thresholds of each pixel.   MORE: JITTER (thresholds drawn per event) or REFRACTORY (dead time), which look at
// events one by one and have state of their own.   LONG: intervals of 2^31 ns and more.
#include "events.glsl"
#include "words64.glsl"
#include "log_q25.glsl"
#if defined(JITTER) || defined(REFRACTORY)
#define MORE
#define RECORD 2u
#else
#define RECORD 1u
#endif
#ifdef JITTER
#include "normal.glsl"
#endif
layout(local_size_x = 256) in;

// (Eight buffers are what OpenGL 4.3 promises.)
layout(std430, binding = 0) restrict buffer Listed { Head head; uvec2 listed[]; };
layout(std430, binding = 1) restrict buffer Records { ivec4 records[]; };
layout(std430, binding = 2) restrict buffer Counts { uint counts[]; };
#ifdef SPREAD
layout(std430, binding = 3) readonly restrict buffer Thresholds { ivec2 thresholds[]; };
#endif
#ifdef EMIT
layout(std430, binding = 4) readonly restrict buffer Offsets { uint offsets[]; };
layout(std430, binding = 5) writeonly restrict buffer Packed { uvec2 packed_events[]; };
#else
layout(std430, binding = 4) readonly restrict buffer Now { float now[]; };
layout(std430, binding = 5) readonly restrict buffer Before { int before[]; }; // intensity, or logarithms
layout(std430, binding = 6) restrict buffer Levels { ivec2 levels[]; }; // upper, lower
#ifdef MORE
layout(std430, binding = 7) restrict buffer State { uvec4 state[]; }; // levels passed, -, time of the last event in ns
#endif
#endif

uniform bool before_is_log;
uniform uint width;
uniform uint capacity;
#ifdef BATCH
uniform uint cuts_at; // in Counts: where the tiles' cut events are counted
#endif
#include "tiles.glsl"

ivec2 own_steps(uint pixel)
{
#ifdef SPREAD
    return thresholds[pixel];
#else
    return steps;
#endif
}

// a / b of numbers below 2^31 with a quotient below 2^20: a float is off by one at most.
uint quotient_of(uint a, uint b)
{
    uint guess = uint(int(float(int(a)) / float(int(b))));
    guess -= uint(guess * b > a);
    return guess + uint(a - guess * b >= b);
}

#ifdef LONG
// Nanoseconds after the microsecond; dt as two digits of base 2^20.
uvec2 crossing(uint part, uint whole)
{
    uint rest, high = divide64(mul64(part, right64(dt_ns, 20u).x), whole, rest);
    uint low = divide64(add64(left64(uvec2(rest, 0u), 20u), mul64(part, dt_ns.x & 0xFFFFFu)), whole, rest);
    return add64(add64(left64(uvec2(high, 0u), 20u), uvec2(low, 0u)), uvec2(start_ns, 0u));
}
#else
uvec2 crossing(uint part, uint whole)
{
    uint rest;
    return uvec2(start_ns + divide64(mul64(part, dt_ns.x), whole, rest), 0u);
}
#endif

uint microseconds(uvec2 ns)
{
#ifdef LONG
    uint rest;
    return divide64(ns, 1000u, rest);
#else
    return ns.x / 1000u;
#endif
}

#ifdef REFRACTORY
// Whether a pixel is awake again, whose last event it then is.
bool awake(uvec2 after_ns, inout uvec2 last_ns)
{
    uvec2 t = add64(base_ns, after_ns);
    bool alive = at_least64(sub64(t, last_ns), refractory_ns);
    last_ns = alive ? t : last_ns;
    return alive;
}
#endif

#ifdef JITTER
// The next thresholds, drawn once per level and numbered by the levels passed.
ivec2 next_steps(uint pixel, uint passed, ivec2 own)
{
    DOUBLE on, off, spread = DOUBLE_OF(jitter);
    normal2(seed, pixel, JITTER_STREAM, passed, on, off);
    ivec2 drawn = ivec2(
        floor_of(WORDS_OF(add_double(mul_double(spread, on), HALF_DOUBLE))),
        floor_of(WORDS_OF(add_double(mul_double(spread, off), HALF_DOUBLE)))
    );
    return max(floors, own + drawn);
}
#endif

#ifdef EMIT
void main()
{
    uint k = gl_GlobalInvocationID.x;
    if (k >= head.pixels) {
        return;
    }
    ivec4 record = records[RECORD * k];
    uint count = counts[k], at = offsets[k], whole = uint(record.y), word = uint(record.w);
    uint upper_word = uint(record.z) >> 31;
    int gap = record.x, step_ = record.z & 0x7FFFFFFF;
#if defined(BATCH) || defined(MORE)
    uint pixel = listed[k].x;
#endif
#ifdef MORE
    ivec2 own = own_steps(pixel);
#endif
#ifdef BATCH
    enter(pixel);
#endif
#if !defined(MORE) && !defined(LONG)
    // One step of the level takes always as long: whole nanoseconds and a rest of 1 / whole of one, so that two divisions
    // do for all events of a pixel.
    uint rest, rest_of_step, part = count > 1u ? uint(step_) : 0u;
    uint t = start_ns + divide64(mul64(whole - uint(gap), dt_ns.x), whole, rest);
    uint dt = divide64(mul64(part, dt_ns.x), whole, rest_of_step);
    for (uint n = 0u; n < count; ++n) {
        if (at + n < capacity) {
            packed_events[at + n] = uvec2(word, (t / 1000u << 1) | upper_word);
        }
        rest += rest_of_step;
        uint carry = uint(rest >= whole);
        rest -= carry * whole;
        t += dt + carry;
    }
#else
#ifdef MORE
    uvec4 more = uvec4(records[RECORD * k + 1u]);
#endif
    uint done = 0u;
    while (done < count) {
        uvec2 after_ns = crossing(whole - uint(gap), whole);
        bool alive = true;
#ifdef REFRACTORY
        alive = awake(after_ns, more.zw);
#endif
        if (alive) {
            if (at + done < capacity) {
                packed_events[at + done] = uvec2(word, (microseconds(after_ns) << 1) | upper_word);
            }
            done += 1u;
        }
#ifdef JITTER
        more.x += 1u;
        ivec2 next = next_steps(pixel, more.x, own);
        step_ = (word & 1u) == 1u ? next.x : next.y;
#endif
        gap -= step_;
    }
#endif
}
#else
void main()
{
    uint k = gl_GlobalInvocationID.x;
    if (k >= head.pixels) {
        counts[k] = 0u; // up to the end of the last chunk
        return;
    }
    uvec2 this_one = listed[k];
    uint pixel = this_one.x, limit = this_one.y, place = pixel;
#ifdef BATCH
    uint tile = enter(place);
    bool swapped = here.swapped != 0u;
    int level = log_of(swapped ? intBitsToFloat(before[pixel]) : now[pixel], eps);
    int from = log_of(swapped ? now[pixel] : intBitsToFloat(before[pixel]), eps);
#else
    int level = log_of(now[pixel], eps);
    int from = before_is_log ? before[pixel] : log_of(intBitsToFloat(before[pixel]), eps);
#endif
    ivec2 next = own_steps(pixel), own = next;
    ivec2 reach = levels[pixel];
    bool up = level >= reach.x;
    // The path is `whole` units long, and ends `gap` beyond the level that is being passed.
    int whole = abs(level - from), gap = up ? level - reach.x : reach.y - level;
    int step_ = up ? own.x : own.y;
    uint y = quotient_of(place, width), x = place - y * width;
#ifdef BATCH
    y += tile * height; // so that events say whose they are
#endif
    uint word = (y << 17) | (x << 1) | uint(up);
    records[RECORD * k] = ivec4(gap, whole, step_ | int((y >> 15) << 31), word);
    uint alive = 0u;
#ifdef MORE
    uvec4 more = state[pixel];
    records[RECORD * k + 1u] = ivec4(more);
    while (gap >= 0) {
#ifdef REFRACTORY
        alive += uint(awake(crossing(uint(whole - gap), uint(whole)), more.zw));
#else
        alive += 1u;
#endif
#ifdef JITTER
        more.x += 1u;
        next = next_steps(place, more.x, own);
        step_ = up ? next.x : next.y;
#endif
        gap -= step_;
    }
    state[pixel] = more;
#else
    alive = quotient_of(uint(gap), uint(step_)) + 1u;
    gap -= int(alive) * step_;
#endif
    int passed = up ? level - (gap + step_) : level + (gap + step_);
    levels[pixel] = ivec2(passed + next.x, passed - next.y);
    counts[k] = min(alive, limit);
    if (alive > limit) {
        atomicAdd(head.cut, alive - limit);
#ifdef BATCH
        atomicAdd(counts[cuts_at + tile], alive - limit);
#endif
    }
}
#endif
