#version 430 core
// Shadow map: only depth, as a lamp sees the scene. Of closed meshes the sides that face it are drawn: the lower side
// of a box on the ground is as far from the lamp as the ground, which would then be lit along the box's edge. PARALLEL:
// of a sun.
#include "vertex.glsl"

#ifdef FRAGMENT_SHADER
#ifdef PARALLEL
// Without perspective drop_artefact() cannot detect a triangle without width, which may have any depth.
const float SHEER = 0.25; // of the map's whole depth, per texel
#else
#include "guard.glsl"
#endif

void main()
{
#ifdef PARALLEL
    if (floatBitsToUint(fwidth(gl_FragCoord.z)) > floatBitsToUint(SHEER)) // NaN, too
        discard;
#ifdef MASKED
    if (is_hole())
        discard;
#endif
#else
    drop_artefact();
#endif
}
#endif
