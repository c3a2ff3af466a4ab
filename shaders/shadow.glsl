#version 430 core
// Shadow map: depth alone, as a lamp sees the scene. Of closed meshes the sides that face away from it are drawn, so that
// no surface that it lights is in its own way.
#include "vertex.glsl"

#ifdef FRAGMENT_SHADER
#include "guard.glsl"

// Parallel light has no perspective by which drop_artefact() could tell: a triangle without width has any depth.
const float SHEER = 0.25; // of the map's whole depth, per texel

void main()
{
    if (fwidth(gl_FragCoord.z) > SHEER)
        discard;
    drop_artefact();
}
#endif
