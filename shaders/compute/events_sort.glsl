// A radix sort of packed events by the time in their upper word, from the lowest digit up (Knuth, TAOCP 3, 5.2.5): four bits
// a pass, a part of 64 events an invocation. Every pass keeps the order of equal digits, so events of one microsecond
// stay in the order in which they were emitted, as the processor's sort leaves them.
// DIGITS : how often each digit is in each part, digit by digit.   SCATTER : the events where the prefix sums say.
#include "events.glsl"
layout(local_size_x = 64) in;

layout(std430, binding = 0) readonly restrict buffer Heads { Head head; };
layout(std430, binding = 1) readonly restrict buffer Given { uvec2 given[]; };
#ifdef DIGITS
layout(std430, binding = 2) writeonly restrict buffer Digits { uint digits[]; };
#else
layout(std430, binding = 2) readonly restrict buffer Places { uint places[]; };
layout(std430, binding = 3) writeonly restrict buffer Sorted { uvec2 sorted[]; };
#endif
uniform uint shift; // of the digit in the time
uniform uint capacity;

void main()
{
    uint part = gl_GlobalInvocationID.x;
    if (part >= head.parts) {
        return;
    }
    uint first = PART * part, stop = max(first, min(first + PART, min(head.events, capacity)));
    uint count[16];
#ifdef DIGITS
    for (uint digit = 0u; digit < 16u; ++digit) {
        count[digit] = 0u;
    }
    for (uint k = first; k < stop; ++k) {
        count[(given[k].y >> shift) & 15u] += 1u;
    }
    for (uint digit = 0u; digit < 16u; ++digit) {
        digits[digit * head.parts + part] = count[digit];
    }
#else
    for (uint digit = 0u; digit < 16u; ++digit) {
        count[digit] = places[digit * head.parts + part];
    }
    for (uint k = first; k < stop; ++k) {
        uvec2 event = given[k];
        uint digit = (event.y >> shift) & 15u;
        sorted[count[digit]] = event;
        count[digit] += 1u;
    }
#endif
}
