// The pixels that fire, in raster order, each with the number of events that it may have: a word of 32 an invocation.
#include "events.glsl"
layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly restrict buffer Marks { uint marks[]; };
layout(std430, binding = 1) readonly restrict buffer Offsets { uint offsets[]; };
layout(std430, binding = 2) readonly restrict buffer Blocks { uint blocks[]; }; // 32 words: where they begin
layout(std430, binding = 3) writeonly restrict buffer Listed { Head head; uvec2 listed[]; };
uniform uint words;
#ifdef V2E
// As many as levels fit between the first one and the farthest of the block, rounded up, and its noise.
#include "doubles.glsl"
#include "v2e_numbers.glsl"
layout(std430, binding = 4) readonly restrict buffer Farthest { uint farthest[]; };
#ifdef SHOTS
layout(std430, binding = 5) readonly restrict buffer Shots { uvec4 shots[]; };
uniform uint room;
#endif
#include "v2e_tiles.glsl"

uint limit_of(uint block, uint count)
{
    FLOAT beyond = FLOAT_OF(farthest[block]);
    beyond = less_float(F_FARTHEST, beyond) ? F_FARTHEST : beyond;
    uint most = min(whole_of(WORDS_OF(mul_double(widened(beyond), DOUBLE_OF(inverse_threshold)))).x + 2u, bound);
#ifdef SHOTS
    most += shots[(room + 1u) * block].x;
#endif
    return most > share / count ? max(1u, share / count) : most;
}
#else
#include "tiles.glsl"

uint limit_of(uint block, uint count)
{
    return share / count;
}
#endif

void main()
{
    uint word = gl_GlobalInvocationID.x;
    if (word >= words) {
        return;
    }
#ifdef BATCH
    uint pixel = word * WORD;
    enter(pixel);
#endif
    uint bits = marks[word], at = offsets[word], block = word / WORD;
    uint limit = limit_of(block, max(blocks[block + 1u] - blocks[block], 1u));
    while (bits != 0u) {
        listed[at] = uvec2(word * WORD + uint(findLSB(bits)), limit);
        bits &= bits - 1u;
        at += 1u;
    }
}
