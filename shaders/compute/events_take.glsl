// A frame that was drawn on this card, a pixel an invocation, into the buffer that the kernels of events read.
#include "events.glsl"
layout(local_size_x = 256) in;

layout(std430, binding = 0) writeonly restrict buffer Now { uint now[]; };
layout(std430, binding = 1) restrict buffer Heads { Head head; };
uniform sampler2D frame;
uniform uint width;
uniform uint pixels;
uniform uint limit; // bits of the largest value; those of negative numbers, infinities and NaN are larger

void main()
{
    uint pixel = gl_GlobalInvocationID.x;
    if (pixel >= pixels) {
        return;
    }
    uint y = pixel / width, bits = floatBitsToUint(texelFetch(frame, ivec2(pixel - y * width, y), 0).x);
    now[pixel] = bits;
    if (bits > limit && bits != 0x80000000u) { // minus zero is zero
        atomicOr(head.unusable, 1u);
    }
}
