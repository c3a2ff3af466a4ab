// Image motion of a surface point from its object-local position, free of cancellation.
//
// With P the clip position now, D = (MVP' - MVP) composed in float64 and cast once, d = D * p and w' = w + d.w:
//   ndc' - ndc = (d.xy - ndc.xy * d.w) / w'
// Subtracting two projected positions instead (c1/w1 - c0/w0) leaves float32 rounding of the positions, 1e-4 px,
// in the result however small the motion is. ndc comes from gl_FragCoord, which is exact.

//
// LENS: in pixels of a lens with distortion (lens.glsl), not in those of its pinhole picture.
#include "along_ray.glsl"
#ifdef LENS
#include "lens.glsl"
#endif

const float BEYOND = 1e37; // px, px/s: beyond it values are not distinguished from infinity

vec2 ndc_of_fragment(vec2 image_size)
{
    return FRAGMENT_XY / image_size * 2.0 - 1.0;
}

// In the limit: d(ndc)/dt = (d.xy - ndc.xy * d.w) / w with d = d(MVP)/dt * p (for a deforming shape: d(MVP)/dt * q +
// MVP * dq/dt); half the image is one unit of ndc.
// rate: rows x, y, w of d(MVP)/dt.  Returns px/s, at most BEYOND, whose square is infinite.
vec2 velocity(mat4x3 rate, vec3 local, vec2 image_size)
{
    vec3 d = rate * vec4(local, 1.0);
#if defined(DEFORM) && defined(NEEDS_RATE)
    d += shape_rate;
#endif
// With a lens: motion on the image plane, times the Jacobian of the lens.
#ifdef LENS
    vec2 ndc = ndc_of_fragment(image_size);
    vec2 v = lens_slope(on_plane(ndc)) * ((d.xy - ndc * d.z) * INVERSE_DEPTH * lens_plane.xy) * lens_focal;
#else
    vec2 v = (d.xy - ndc_of_fragment(image_size) * d.z) * INVERSE_DEPTH * 0.5 * image_size;
#endif
    return clamp(v, -BEYOND, BEYOND);
}
