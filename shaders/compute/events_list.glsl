// The pixels that fire, in raster order, each with the number of events that it may have: a word of 32 an invocation.
#include "events.glsl"
layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly restrict buffer Marks { uint marks[]; };
layout(std430, binding = 1) readonly restrict buffer Offsets { uint offsets[]; };
layout(std430, binding = 2) readonly restrict buffer Blocks { uint blocks[]; }; // 32 words: where they begin
layout(std430, binding = 3) writeonly restrict buffer Listed { Head head; uvec2 listed[]; };
uniform uint words;
#include "tiles.glsl"

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
    uint limit = share / max(blocks[block + 1u] - blocks[block], 1u);
    while (bits != 0u) {
        listed[at] = uvec2(word * WORD + uint(findLSB(bits)), limit);
        bits &= bits - 1u;
        at += 1u;
    }
}
