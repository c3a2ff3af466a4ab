#version 430 core
// Label pass: any subset of the shader's labels at once. The renderer defines OUT_<NAME> as the attachment number of
// each requested label. include/labels/<name>.glsl, or the label's row (blinkgl/labels), computes a label; the includes
// labels_need.glsl and labels.glsl are generated from the table of labels (blinkgl/labels/table.py).
//
// A label is a function label_<name>(), which may use
//   local        object-local position, and uniform vec2 image_size (include/image_size.glsl), px of the target
//   facing()     normal in the object's axes, on the camera's side, not normalised
// INVERSE_DEPTH, FRAGMENT_XY   gl_FragCoord.w and .xy of the ray through the fragment (include/along_ray.glsl)
// TWO_SIDED: as in luminance.glsl.

#include "labels_need.glsl"
#include "vertex.glsl"

#ifdef FRAGMENT_SHADER
#include "guard.glsl"
#include "along_ray.glsl"
#ifdef NEEDS_NORMAL
vec3 facing()
{
#ifdef TWO_SIDED
    return gl_FrontFacing ? normal : -normal;
#else
    return normal;
#endif
}
#endif
#include "labels.glsl"

void main()
{
#ifdef LENS_CLAIMS
    look_along_ray();
#endif
    write_labels();
    drop_artefact();
}
#endif
