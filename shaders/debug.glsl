#version 430 core
// The pass of the shader debugger (tools/shader_debugger): the primitive that wrote the pixel, and the place on it.
// Generation does not use it. It repeats the vertex stage of luminance.glsl and label.glsl, so that it covers the same
// fragments. Those programs show their own lookups and intermediate values: see include/lookup.glsl.
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
