#version 430 core
// Depth alone, as the lamp sees it.
#include "vertex.glsl"

#ifdef FRAGMENT_SHADER
#include "guard.glsl"

void main()
{
    drop_artefact();
}
#endif
