// Drops the artefacts of triangles without width: collinear ones, and any seen from its edge. Corners are snapped to a
// fraction of a pixel and may then cover a pixel's centre, while gradients are divided by the area before the snapping:
// 1/w and everything interpolated with it may have any value there, NaN included.
//
// Bit patterns of floats >= 0 have the order of the numbers, and those of negative numbers, infinities and NaN are
// larger. So values are compared as unsigned integers: compilers may turn !(a < b) into a >= b, which is wrong for NaN.

#ifndef LENS_CLAIMS // behind a lens rays meet the facets themselves (along_ray.glsl)
// Smallest 1/Z of the part in this frame, as bits; the difference of the largest's bits to them.
uniform uvec2 inverse_depths;

// Corners are snapped to 1/256 px: where depth changes by more than a quarter over that, it is unknown.
const float STEEPEST = 64.0; // of its own value, per pixel
#endif

// Drops a fragment whose depth the part does not have. Call it last: derivatives are undefined after a discard.
void drop_artefact()
{
#ifndef LENS_CLAIMS
    float W = gl_FragCoord.w; // 1/Z: the projection's w is the depth along the optical axis
    // Below the smallest, the unsigned difference wraps round and is large, too: one comparison for both ends
    // and for NaN.
    if (floatBitsToUint(W) - inverse_depths.x > inverse_depths.y || fwidth(W) > STEEPEST * W)
        discard;
#endif
#ifdef MASKED
    if (is_hole())
        discard;
#endif
}

// Texture coordinates that are safe for differences between neighbours. Beside a surface that ends at the horizon the
// outside neighbour may have 1/w = 0; it then counts as far away, which selects the coarsest mip level.
const uint REPEATS = 0x4e6e6b28u; // bits of 1e9, beyond which a float tells nothing about a texture
vec2 within_reach(vec2 at)
{
    uvec2 size = floatBitsToUint(at) & 0x7fffffffu;
    return max(size.x, size.y) < REPEATS ? at : vec2(1e6);
}

// 0 for NaN.
float finite(float value)
{
    return (floatBitsToUint(value) & 0x7fffffffu) < 0x7f800000u ? value : 0.0;
}
