#version 430 core
// Shadow map: depth alone, as a lamp sees the scene. Of closed meshes the sides that face it are drawn: the lower side
// of a box that stands on the ground is as far from the lamp as the ground, which would be lit along the box's edge.
#include "vertex.glsl"

#ifdef FRAGMENT_SHADER
#ifdef PARALLEL
// Parallel light has no perspective by which drop_artefact() could tell: a triangle without width has any depth.
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
