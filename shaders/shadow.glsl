#version 430 core
// Shadow map: depth alone, as a lamp sees the scene. Of closed meshes the sides that face away from it are drawn, so that
// no surface that it lights is in its own way.
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
