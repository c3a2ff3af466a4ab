// Displacement of a surface point until another time, in px (motion.glsl explains how cancellation is avoided).
#include "motion.glsl"
#ifdef LENS
#include "lens_far.glsl"
#endif

// For a deforming shape, q replaces p, and its own change is added: d = D * q + MVP' * (q' - q), the second term from
// the vertex stage.
//
// d: rows x, y, w.  Returns (u, v in px, w' in world units).  w' <= 0: behind the camera, or so near to its plane that
// the flow exceeds float32; then u = v = 0.
vec3 displacement(vec3 d, vec2 image_size)
{
    float w_next = 1.0 / INVERSE_DEPTH + d.z;
#ifdef LENS
    // The position on the lens's image plane, its change, and the resulting px of the lens.
    vec2 ndc = ndc_of_fragment(image_size), place = on_plane(ndc);
    vec2 change = (d.xy - ndc * d.z) / w_next * lens_plane.xy;
    vec2 flow = lens_difference(place, change) * lens_focal;
    bool usable = w_next > 0.0 && max(abs(flow.x), abs(flow.y)) < BEYOND && lens_sees(place + change);
#else
    vec2 flow = (d.xy - ndc_of_fragment(image_size) * d.z) / w_next * 0.5 * image_size;
    bool usable = w_next > 0.0 && max(abs(flow.x), abs(flow.y)) < BEYOND;
#endif
    return usable ? vec3(flow, w_next) : vec3(0.0, 0.0, min(w_next, 0.0));
}

// The same for a rigid body. difference: rows x, y, w of D.
vec3 displacement(mat4x3 difference, vec3 local, vec2 image_size)
{
    return displacement(difference * vec4(local, 1.0), image_size);
}
