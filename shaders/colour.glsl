#version 430 core
// Colour pass: linear radiance, rgb, into one target. Material variants as in luminance.glsl: TEXTURED, LIT, TWO_SIDED, LIGHTS, HUED.
// SHOW_LOOKUP, the shader debugger's: also writes what was looked up, see lookup.glsl.

#ifdef LIT
#define NEEDS_NORMAL
#endif
#ifdef TEXTURED
#define NEEDS_UV
#endif
#if defined(LAMPS) || defined(SHADOWS)
#define NEEDS_LOCAL
#endif
#include "vertex.glsl"

#ifdef FRAGMENT_SHADER
#ifdef SHOW_LOOKUP
#include "lookup.glsl"
#endif
layout(location = 0) out vec4 colour;
uniform vec3 base_color;
#ifdef TEXTURED
uniform sampler2D albedo;
#endif
#ifdef LIT
#include "light.glsl"
#endif
#ifdef FOG
#include "fog.glsl"
#endif
#include "guard.glsl"

void main()
{
    vec3 radiance = base_color;
#ifdef TEXTURED
    vec2 uv = within_reach(uv); // hides the varying
    radiance *= texture(albedo, uv).rgb;
#endif
#ifdef LIT
#ifdef TWO_SIDED
    vec3 facing = gl_FrontFacing ? normal : -normal;
#else
    vec3 facing = normal;
#endif
    ILLUMINANT light = irradiance(facing);
#else
    const float light = 1.0;
#endif
#ifdef SHOW_LOOKUP
#ifdef HUED
    vec3 weighed = radiance * vec3(0.2126, 0.7152, 0.0722); // Rec. 709
    show_lookup(radiance, dot(weighed, light) / max(weighed.r + weighed.g + weighed.b, 1e-30));
#else
    show_lookup(radiance, light);
#endif
#endif
#ifdef LIT
    radiance *= light;
#endif
#ifdef FOG
    radiance = in_fog(radiance);
#endif
    colour = vec4(radiance, 1.0);
    drop_artefact();
}
#endif
