// V2E, first of a step: a block of 1024 pixels an invocation. Its marks are wiped, and with SHOTS its clock runs to the
// interval's end: candidates of shot noise as fast as if all pixels were dark, thinned to what their light allows
// (blinkgl/events/v2e.py, _shot_block). The events of a pixel are a chain in their order, which is that of their times. So
// many candidates are drawn in a go, and it is run until there are none left.
#include "events.glsl"
#include "v2e.glsl"
#include "v2e_tiles.glsl"
layout(local_size_x = 64) in;

layout(std430, binding = 0) restrict buffer Heads { Head head; };
layout(std430, binding = 1) restrict buffer Marks { uint marks[]; };
layout(std430, binding = 2) writeonly restrict buffer Farthest { uint farthest[]; };
#ifdef SHOTS
layout(std430, binding = 3) restrict buffer Shots { uvec4 shots[]; }; // of each block: how many, and as many as there is
    // room for: ns << 1 | polarity in two words, number of the pixel's next one
#ifdef BATCH
layout(std430, binding = 5) restrict buffer Both { uint both[]; };
#else
layout(std430, binding = 4) readonly restrict buffer Before { uint before[]; };
layout(std430, binding = 5) restrict buffer Now { uint now[]; };
#endif
layout(std430, binding = 6) readonly restrict buffer Table { uint table[]; };
#endif
uniform uint blocks;
#ifdef SHOTS
uniform uint padded; // pixels, whole blocks: the length of a plane
uniform uint pixels; // of a picture
uniform uint room; // for events of a block
uniform bool goes_on; // not the first go
uniform bool last; // the last one
const uint ENTRIES = 2048u, GO = 128u, NONE = 0xFFFFFFFFu;
#define CLOCK(K) (goes_on ? NOW_AT(clock + K) : BEFORE_AT(clock + K))

DOUBLE uniform_at(uint block, uvec2 index, bool second)
{
    uvec4 words = philox4x32(uvec4(block, SHOT_STREAM, index), seed);
    return uniform_of(second ? words.zw : words.xy);
}
#endif

void main()
{
    uint block = gl_GlobalInvocationID.x;
    if (block >= blocks) {
        return;
    }
#ifdef BATCH
    uint own = 1024u * block;
    enter(own);
    own /= 1024u;
#else
    uint own = block;
#endif
#ifdef SHOTS
    uint clock = PLANES * padded + 4u * block, first = (room + 1u) * block + 1u, count = goes_on ? shots[first - 1u].x : 0u;
    uvec2 after = sub64(uvec2(CLOCK(0u), CLOCK(1u)), start), index = uvec2(CLOCK(2u), CLOCK(3u));
    if (!goes_on)
#endif
    {
        for (uint word = 0u; word < WORD; ++word) {
            marks[WORD * block + word] = 0u;
        }
        farthest[block] = 0u;
    }
#ifdef SHOTS
#ifdef BATCH
    if (here.fires == 0u) { // its clock stands still
        shots[first - 1u] = uvec4(0u);
        return;
    }
#endif
    DOUBLE whole = widened(FLOAT_OF(table[ENTRIES * block + ENTRIES - 1u]));
    DOUBLE rate = mul_double(DOUBLE_OF(shot_unit), whole);
    for (uint turn = 0u; turn < GO && (int(after.y) < 0 || at_least64(dt_ns, after)); ++turn) {
        uvec2 twice = left64(index, 1u), odd = twice | uvec2(1u, 0u);
        DOUBLE gap = div_double(negative(log_double(uniform_at(own, twice, false))), rate);
        if (less_double(D_MOST_NS, gap)) {
            gap = D_MOST_NS;
        }
        DOUBLE pick = uniform_at(own, twice, true), accept = uniform_at(own, odd, false);
        uint weight = BITS_OF(narrowed(mul_double(pick, whole))), place = 0u;
        for (uint reach = ENTRIES / 2u; reach > 0u; reach >>= 1) { // how many entries are <= weight
            place += table[ENTRIES * block + place + reach - 1u] <= weight ? reach : 0u;
        }
        uint offset = place & 1023u, pixel = 1024u * block + offset;
        if (1024u * own + offset < pixels) {
            uvec2 ns = int(after.y) < 0 ? uvec2(0u) : after;
            FLOAT light = FLOAT_OF(BEFORE_AT(LIGHT * padded + pixel));
            FLOAT change = sub_float(mul_float(FLOAT_OF(NOW_AT(FRAME * padded + pixel)), FLOAT_OF(scale)), light);
            DOUBLE part = div_double(DOUBLE_OF(double_of(ns)), DOUBLE_OF(dt_whole));
            DOUBLE lit = add_double(widened(light), mul_double(widened(change), part));
            DOUBLE level = div_double(add_double(lit, D_TWENTY), D_SPAN); // > 0
            if (less_double(ONE_DOUBLE, level)) {
                level = ONE_DOUBLE;
            }
            DOUBLE factor = sub_double(ONE_DOUBLE, mul_double(D_THREE_QUARTERS, level));
            if (less_double(mul_double(accept, D_DARKEST), factor)) {
                if (count < room) {
                    uint word = WORD * block + offset / WORD, bit = 1u << (offset & 31u);
                    if ((marks[word] & bit) == 0u) {
                        marks[word] |= bit;
                        NOW_AT(FIRST_SHOT * padded + pixel) = count;
                    } else {
                        shots[first + NOW_AT(LAST_SHOT * padded + pixel)].z = count;
                    }
                    NOW_AT(LAST_SHOT * padded + pixel) = count;
                    shots[first + count] = uvec4(left64(ns, 1u) | uvec2(uint(place < 1024u), 0u), NONE, 0u);
                }
                count += 1u;
            }
        }
        index = add64(index, uvec2(1u, 0u));
        after = add64(after, add64(nanoseconds(gap), uvec2(1u, 0u)));
    }
    if (last && (count > room || int(after.y) < 0 || at_least64(dt_ns, after))) {
        atomicOr(head.unusable, 2u); // nothing fires, and it is done again with more room and goes
    }
    shots[first - 1u] = uvec4(count, 0u, 0u, 0u);
    after = add64(after, start);
    NOW_AT(clock) = after.x;
    NOW_AT(clock + 1u) = after.y;
    NOW_AT(clock + 2u) = index.x;
    NOW_AT(clock + 3u) = index.y;
#endif
}
