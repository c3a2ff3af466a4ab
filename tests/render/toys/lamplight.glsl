#version 430 core
// 1 where the lamp is seen from the surface, 0 in the shadow of something.
#define NEEDS_LOCAL
#include "vertex.glsl"

#ifdef FRAGMENT_SHADER
layout(location = 0) out float light;
uniform mat4 lamp_from_local; // the lamp's clip space
uniform sampler2D shadows;    // its depth buffer
#include "guard.glsl"

void main()
{
    vec4 there = lamp_from_local * vec4(local, 1.0);
    float depth = there.z / there.w, nearest = texture(shadows, there.xy / there.w * 0.5 + 0.5).r;
    light = nearest > 1.01 * depth ? 0.0 : 1.0; // reversed-Z: what is nearer to the lamp is larger
    drop_artefact();
}
#endif
