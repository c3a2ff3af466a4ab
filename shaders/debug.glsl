#version 430 core
// The shader debugger's own pass (blinkgl/shader_debugger): which primitive wrote the pixel, and where on it.
// Generation never asks for this program. It repeats the vertex stage of luminance.glsl and label.glsl, so that it
// covers the same fragments. What those look up and compute on the way they show themselves: see include/lookup.glsl.
//
//   OUT_TRIANGLE  gl_PrimitiveID + 1 within the part (0: nothing hit)
//   OUT_LOCAL     object-local position, part number + 1
//   OUT_WINDOW    gl_FragCoord

#define NEEDS_LOCAL
#include "vertex.glsl"

#ifdef FRAGMENT_SHADER
layout(location = OUT_TRIANGLE) out uint triangle;
layout(location = OUT_LOCAL) out vec4 local_position;
layout(location = OUT_WINDOW) out vec4 window;

uniform float part_number;
#include "guard.glsl"

void main()
{
    triangle = uint(gl_PrimitiveID) + 1u;
    local_position = vec4(local, part_number);
    window = gl_FragCoord;
    drop_artefact();
}
#endif
