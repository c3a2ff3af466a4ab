// Which pixels have reached a level: a bit each, 32 pixels an invocation. What is read here, 12 bytes a pixel, is all that
// a pixel without events costs.
#include "events.glsl"
#include "log_q25.glsl"
layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly restrict buffer Intensity { vec4 intensity[]; };
layout(std430, binding = 1) readonly restrict buffer Levels { ivec4 levels[]; }; // upper and lower of two pixels
layout(std430, binding = 2) writeonly restrict buffer Marks { uint marks[]; };
#ifdef CHECKED
layout(std430, binding = 3) restrict buffer Heads { Head head; };
uniform uint limit; // bits of the largest value; those of negative numbers, infinities and NaN are larger
#endif
#ifdef BATCH
layout(std430, binding = 4) readonly restrict buffer Before { vec4 before[]; };
#endif
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
    if (here.fires == 0u) {
        marks[word] = 0u;
        return;
    }
    bool swapped = here.swapped != 0u;
#endif
    const ivec4 SIDES = ivec4(1, -1, 1, -1);
    const uvec4 FIRST = uvec4(1u, 1u, 2u, 2u), SECOND = uvec4(4u, 4u, 8u, 8u);
    uint bits = 0u;
#ifdef CHECKED
    uvec4 most = uvec4(0u);
#endif
    for (uint k = 0u; k < 8u; ++k) {
#ifdef BATCH
        vec4 four = swapped ? before[8u * word + k] : intensity[8u * word + k];
#else
        vec4 four = intensity[8u * word + k];
#endif
        ivec4 now = log_of(four, eps);
        // Above the upper level or below the lower one: neither difference is negative then.
        ivec4 first = (now.xxyy - levels[16u * word + 2u * k]) * SIDES;
        ivec4 second = (now.zzww - levels[16u * word + 2u * k + 1u]) * SIDES;
        uvec4 fired = (FIRST & uvec4(~(first >> 31))) | (SECOND & uvec4(~(second >> 31)));
        bits |= (fired.x | fired.y | fired.z | fired.w) << (4u * k);
#ifdef CHECKED
        uvec4 seen = floatBitsToUint(four);
        most = max(most, seen * uvec4(notEqual(seen, uvec4(0x80000000u)))); // minus zero is zero
#endif
    }
    marks[word] = bits;
#ifdef CHECKED
    if (max(max(most.x, most.y), max(most.z, most.w)) > limit) {
        atomicOr(head.unusable, 1u);
    }
#endif
}
