#version 430 core
// Event pass: linear luminance into one R32F target, nothing else (the event kernel takes the logarithm).
//
// Variants   TEXTURED   albedo luminance from a one-channel texture, else the uniform alone
//            LIT        sun and sky Lambert, else unlit
//            TWO_SIDED  the normal is turned towards the camera on back faces

#ifdef VERTEX_SHADER
in vec3 in_position;
uniform mat4 mvp;
invariant gl_Position;
#ifdef TEXTURED
in vec2 in_uv;
out vec2 uv;
#endif
#ifdef LIT
in vec3 in_normal;
out vec3 normal;
#endif

void main()
{
    gl_Position = mvp * vec4(in_position, 1.0);
#ifdef TEXTURED
    uv = in_uv;
#endif
#ifdef LIT
    normal = in_normal;
#endif
}
#endif

#ifdef FRAGMENT_SHADER
layout(location = 0) out float luminance;
#ifdef TEXTURED
in vec2 uv;
uniform sampler2D albedo;
#else
uniform float albedo;
#endif
#ifdef LIT
in vec3 normal;
#include "light.glsl"
#endif

void main()
{
#ifdef TEXTURED
    luminance = texture(albedo, uv).r;
#else
    luminance = albedo;
#endif
#ifdef LIT
#ifdef TWO_SIDED
    luminance *= irradiance(gl_FrontFacing ? normal : -normal);
#else
    luminance *= irradiance(normal);
#endif
#endif
}
#endif
