// What becomes of events that stay on the card, an event an invocation: sums and maxima of whole numbers, in which the order
// of the atomics leaves no trace.
// VOXELS : (bins, H, W) 2^-16: +1 or -1, shared linearly in time between the two nearest of bins that stand from the
//          window's start to its end.
// COUNTS : (2, H, W) OFF and ON.   LATEST : (2, H, W) 1 + microseconds from the window's start to the last one; 0: none.
// BATCH: events of several tiles, whose rows follow each other and which have a window and such sums each.
#include "words64.glsl"
layout(local_size_x = 256) in;

layout(std430, binding = 0) readonly restrict buffer Packed { uvec2 packed_events[]; };
layout(std430, binding = 1) restrict buffer Sink { int sink[]; };
uniform uint count;
uniform uint width;
uniform uint pixels;
uniform uint rows; // bits of y, without those of the cause
#ifdef BATCH
layout(std430, binding = 2) readonly restrict buffer Windows { ivec2 windows[]; }; // shift and span of each tile
uniform uint height;
uniform uint planes;
#else
uniform int shift_us; // from the window's start to the interval's
uniform uint span_us; // of the window
#endif
uniform uint bins;

void main()
{
    uint k = gl_GlobalInvocationID.x;
    if (k >= count) {
        return;
    }
    uvec2 event = packed_events[k];
    uint x = (event.x >> 1) & 0xFFFFu, y = ((event.x >> 17) | (event.y << 15)) & rows, begin = 0u;
#ifdef BATCH
    uint tile = y / height, span_us = uint(windows[tile].y);
    int shift_us = windows[tile].x;
    begin = tile * planes * pixels;
    y -= tile * height;
#endif
    uint pixel = begin + y * width + x;
    bool on = (event.x & 1u) == 1u;
    int t = int(event.y >> 1) + shift_us;
    if (t < 0 || uint(t) >= span_us) { // half open, as all windows
        return;
    }
#ifdef VOXELS
    uint rest, place = divide64(mul64(uint(t), (bins - 1u) << 16), span_us, rest);
    int later = int(place & 0xFFFFu), sign_ = on ? 1 : -1;
    uint at = (place >> 16) * pixels + pixel;
    atomicAdd(sink[at], sign_ * (65536 - later));
    atomicAdd(sink[min(at + pixels, begin + bins * pixels - 1u)], bins > 1u ? sign_ * later : 0);
#endif
#ifdef COUNTS
    atomicAdd(sink[uint(on) * pixels + pixel], 1);
#endif
#ifdef LATEST
    atomicMax(sink[uint(on) * pixels + pixel], t + 1);
#endif
}
