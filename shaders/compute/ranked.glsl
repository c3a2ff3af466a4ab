// Of a small picture what a timeline needs: how many values move, a percentile's two neighbours in their order, the largest.
// A value is the bits of a float >= 0, which are in the order of the numbers. All of it is whole numbers (the floats are
// computed as such, too), so that it is what the processor finds (blinkgl/timeline/reductions.py), whatever the vendor.
// SPEED  : keys are squares of the lengths of two components.   CHANGE : keys are |rate * d(signal)/d(luminance)|.
// SELECT : one work group ranks the keys, eight bits at a time (Knuth, TAOCP 3, 5.2.5, from the highest digit down).
#ifdef SELECT
#include "soft_double.glsl"
layout(local_size_x = LANES) in;

layout(std430, binding = 0) readonly restrict buffer Keys { uint keys[]; };
layout(std430, binding = 1) writeonly restrict buffer Found { uint found[4]; }; // how many, below, above, largest
uniform uint count;
uniform uvec2 part; // the percentile / 100, a double

shared uint bins[256];
shared uint many, largest, wanted, prefix, next_above;

void main()
{
    uint lane = gl_LocalInvocationIndex;
    if (lane == 0u) {
        many = largest = prefix = 0u;
        next_above = 0xFFFFFFFFu;
    }
    barrier();
    uint mine = 0u, most = 0u;
    for (uint k = lane; k < count; k += uint(LANES)) {
        mine += uint(keys[k] != 0u);
        most = max(most, keys[k]);
    }
    atomicAdd(many, mine);
    atomicMax(largest, most);
    barrier();
    if (lane == 0u) {
        uint last = max(many, 1u) - 1u;
        wanted = many == 0u ? 0u : min(uint(floor_of(mul_double(double_of(uvec2(last, 0u)), part))), last);
    }
    barrier();
    for (uint shift = 32u; shift > 0u;) {
        shift -= 8u;
        for (uint bin = lane; bin < 256u; bin += uint(LANES)) {
            bins[bin] = 0u;
        }
        barrier();
        for (uint k = lane; k < count; k += uint(LANES)) {
            uint key = keys[k];
            bool here = key != 0u && (shift == 24u || (key >> (shift + 8u)) == prefix);
            if (here) {
                atomicAdd(bins[(key >> shift) & 255u], 1u);
            }
        }
        barrier();
        if (lane == 0u) {
            uint bin = 0u, left = wanted;
            while (bin < 255u && left >= bins[bin]) {
                left -= bins[bin];
                bin += 1u;
            }
            wanted = left;
            prefix = (prefix << 8) | bin;
            if (shift == 0u) {
                next_above = left + 1u < bins[bin] ? prefix : 0xFFFFFFFFu; // there is another of the same value
            }
        }
        barrier();
    }
    uint below = prefix;
    if (next_above != below) {
        uint least = 0xFFFFFFFFu;
        for (uint k = lane; k < count; k += uint(LANES)) {
            least = keys[k] > below ? min(least, keys[k]) : least;
        }
        barrier(); // all have looked
        atomicMin(next_above, least);
    }
    barrier();
    if (lane == 0u) {
        found[0] = many;
        found[1] = many == 0u ? 0u : below;
        found[2] = many == 0u ? 0u : min(next_above, largest);
        found[3] = largest;
    }
}
#else
#include "soft_float.glsl"
#include "words64.glsl"
layout(local_size_x = 64) in;

layout(std430, binding = 0) writeonly restrict buffer Keys { uint keys[]; };
uniform sampler2D picture;
uniform uint count;
uniform uint width;
uniform uint slowest; // bits of the smallest value that counts
const uint INFINITE = 0x7F800000u;

// a b >= 0 without sign: zero below 2^-126, and what is beyond all bounds no less than INFINITE.
uint product(uint a, uint b)
{
    int exponent = int(a >> 23) + int(b >> 23) - 127;
    if (a >= INFINITE || b >= INFINITE || exponent > 254) {
        return (a >> 23) == 0u || (b >> 23) == 0u ? INFINITE + 1u : INFINITE; // zero times infinity is no number
    }
    return exponent < 1 ? 0u : mul_float(a, b);
}

#ifdef SPEED
uint key_of(vec2 value)
{
    uint x = floatBitsToUint(value.x) & 0x7FFFFFFFu, y = floatBitsToUint(value.y) & 0x7FFFFFFFu;
    uint a = product(x, x), b = product(y, y);
    return max(a, b) >= INFINITE ? INFINITE : add_float(a, b);
}
#endif

#ifdef CHANGE
uniform uint gain;
uniform uint offset;
uniform uint joint;
uniform uint low_slope; // below the joint; 0: the same curve

uint key_of(vec2 value)
{
    uint light = floatBitsToUint(value.x), rate = floatBitsToUint(value.y) & 0x7FFFFFFFu;
    bool number = (light & 0x7FFFFFFFu) <= INFINITE, above = number && light < 0x80000000u && light > joint;
    if (low_slope != 0u && !above) {
        return product(rate, low_slope);
    }
    if (!number) {
        return INFINITE + 1u;
    }
    uint sum = above ? light : joint;
    sum = sum >= INFINITE ? INFINITE : add_float(max(sum, offset), min(sum, offset));
    uint slope = sum >= INFINITE ? 0u : (sum >> 23) == 0u ? INFINITE : div_float(gain, sum);
    return product(rate, slope);
}
#endif

void main()
{
    uint k = gl_GlobalInvocationID.x;
    if (k >= count) {
        return;
    }
    uint key = key_of(texelFetch(picture, ivec2(k % width, k / width), 0).xy);
    keys[k] = key >= slowest && key < INFINITE ? key : 0u;
}
#endif
