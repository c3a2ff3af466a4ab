// Prefix sums in three steps, whole numbers, so that the result has no order of additions in it:
// SUMS    : of every chunk of 32 items;
// SCAN    : one work group makes of those where each chunk begins, and their total;
// OFFSETS : where each item begins.
// Of BITS: items are words whose bits are counted, and the number of items is a uniform; else the items are numbers, as
// many as the head says, of pixels that fire or, with PARTS, of the digits of a sort.
#include "events.glsl"
#ifdef SCAN
layout(local_size_x = LANES) in;
#else
layout(local_size_x = 64) in;
#endif

layout(std430, binding = 0) restrict buffer Heads { Head head; };
layout(std430, binding = 1) readonly restrict buffer Items { uvec4 items[]; };
layout(std430, binding = 2) restrict buffer Sums { uint sums[]; };
#ifdef OFFSETS
layout(std430, binding = 3) writeonly restrict buffer Offsets { uvec4 offsets[]; };
#endif
#ifdef BITS
uniform uint chunks_given;
#define CHUNKS chunks_given
#define NUMBER(ITEM) uvec4(bitCount(ITEM))
#else
#ifdef PARTS
#define CHUNKS head.digit_chunks
#else
uniform uint capacity; // events that there is room for
#define CHUNKS head.chunks
#endif
#define NUMBER(ITEM) ITEM
#endif

#ifdef SUMS
void main()
{
    uint chunk = gl_GlobalInvocationID.x;
    if (chunk >= CHUNKS) {
        return;
    }
    uvec4 sum = uvec4(0u);
    for (uint k = 0u; k < 8u; ++k) {
        sum += NUMBER(items[8u * chunk + k]);
    }
    sums[chunk] = sum.x + sum.y + sum.z + sum.w;
}
#endif

#ifdef OFFSETS
void main()
{
    uint chunk = gl_GlobalInvocationID.x;
    if (chunk >= CHUNKS) {
        return;
    }
    uint begin = sums[chunk];
    for (uint k = 0u; k < 8u; ++k) {
        uvec4 n = NUMBER(items[8u * chunk + k]);
        uvec4 at = begin + uvec4(0u, n.x, n.x + n.y, n.x + n.y + n.z);
        offsets[8u * chunk + k] = at;
        begin = at.w + n.w;
    }
}
#endif

#ifdef SCAN
shared uint partial[LANES];

void main()
{
    uint lane = gl_LocalInvocationIndex, share = (CHUNKS + uint(LANES) - 1u) / uint(LANES);
    uint first = min(lane * share, CHUNKS), stop = min(first + share, CHUNKS);
    uint sum = 0u;
    for (uint k = first; k < stop; ++k) {
        sum += sums[k];
    }
    partial[lane] = sum;
    for (uint reach = 1u; reach < uint(LANES); reach <<= 1) { // Hillis and Steele 1986
        barrier();
        uint before = lane >= reach ? partial[lane - reach] : 0u;
        barrier();
        partial[lane] += before;
    }
    barrier();
    uint begin = partial[lane] - sum, total = partial[LANES - 1];
#ifdef BITS
    total = head.unusable == 0u ? total : 0u;
#endif
    for (uint k = first; k < stop; ++k) {
        uint here = sums[k];
        sums[k] = begin;
        begin += here;
    }
    if (lane == 0u) {
#ifdef BITS
        sums[CHUNKS] = total;
        head.pixels = total;
        head.chunks = (total + WORD - 1u) / WORD;
        head.groups_of_pixels = (total + PER_GROUP - 1u) / PER_GROUP;
        head.groups_of_chunks = (head.chunks + CHUNKS_PER_GROUP - 1u) / CHUNKS_PER_GROUP;
        head.groups_y = head.groups_z = head.chunks_y = head.chunks_z = 1u;
        head.events = 0u;
        head.cut = 0u;
#elif !defined(PARTS)
        head.events = total;
        head.parts = 2u * ((min(total, capacity) + 2u * PART - 1u) / (2u * PART));
        head.groups_of_parts = (head.parts + 63u) / 64u;
        head.digit_chunks = head.parts / 2u;
        head.groups_of_digits = (head.digit_chunks + CHUNKS_PER_GROUP - 1u) / CHUNKS_PER_GROUP;
        head.parts_y = head.parts_z = head.digits_y = head.digits_z = 1u;
#endif
    }
}
#endif
