#version 430 core
// Colour pass: linear radiance, rgb, into one target. Material variants as in luminance.glsl: TEXTURED, LIT, TWO_SIDED,
// LIGHTS, RGB, TINTED, EMISSIVE, EMISSION_MAP, GLOSSY, BUMPED, GLOSS_MAP, MASKED, FOG.
// SHOW_LOOKUP, for the shader debugger: also writes the texture lookups, see lookup.glsl.

#include "needs.glsl"
#include "vertex.glsl"

#ifdef FRAGMENT_SHADER
#if defined(SURFACED) || defined(EMISSION_MAP)
#include "maps.glsl"
#endif
#ifdef SHOW_LOOKUP
#include "lookup.glsl"
#endif
layout(location = 0) out vec4 colour;
uniform vec3 base_color;
#ifdef TEXTURED
uniform sampler2D albedo;
#endif
#define EMITTED vec3
#include "sent.glsl"

void main()
{
    vec3 radiance = base_color;
#ifdef NEEDS_UV
    vec2 uv = within_reach(uv); // hides the varying
#endif
#ifdef TEXTURED
    radiance *= texture(albedo, uv).rgb;
#endif
#ifdef TINTED
    radiance *= tint;
#endif
// The light on the surface: from surface.glsl (below), from the vertex stage, from light.glsl, or none.
#ifdef SURFACED
    float side = SIDE;
#elif defined(LIT_AT_CORNERS)
    LIGHT_HERE light = LIGHT_SEEN;
#elif defined(LIT)
    ILLUMINANT light = irradiance(TURNED(normal));
#else
    const float light = 1.0;
#endif
    vec3 added = vec3(0.0); // light that is not multiplied by the albedo
#ifdef SURFACED
#ifdef BUMPED
    vec4 along = tangent;
#else
    const vec4 along = vec4(0.0);
#endif
#ifndef NEEDS_UV
    const vec2 uv = vec2(0.0);
#endif
// radiated() returns the sum; the part for the albedo is subtracted and multiplied at the end.
#ifdef GLOSSY
    Spot spot = Spot(radiance, normal, along, local, uv);
    added = radiated(spot, side);
    ILLUMINANT light = shown_matt;
    added -= radiance * light;
#else
    radiated(Spot(ILLUMINANT(1.0), normal, along, vec3(0.0), uv), side);
    ILLUMINANT light = shown_matt;
#endif
#endif
#ifdef SHOW_LOOKUP
    vec3 mirrored_light = added;
#endif
#ifdef EMISSIVE
#ifdef EMISSION_MAP
    added += emission * map_at(emission_map, emission_map_place * vec3(uv, 1.0), 0.0).rgb;
#else
    added += emission;
#endif
#endif
// Only for the shader debugger: the terms of the light, as luminance on this surface.
#ifdef SHOW_LOOKUP
#ifndef LIT
    const float shown_direct = 0.0, shown_arrives = 0.0, shown_around = 0.0;
#endif
#ifdef RGB
    vec3 weighed = radiance * vec3(0.2126, 0.7152, 0.0722); // Rec. 709
#define OF_LUMINANCE(light) (dot(weighed, light) / max(weighed.r + weighed.g + weighed.b, 1e-30))
#else
#define OF_LUMINANCE(light) (light)
#endif
    show_lookup(radiance, vec3(light), OF_LUMINANCE(light), mirrored_light, added - mirrored_light,
                OF_LUMINANCE(shown_direct), OF_LUMINANCE(shown_arrives), OF_LUMINANCE(shown_around));
#endif
#ifdef LIT
    radiance *= light;
#endif
#if defined(EMISSIVE) || defined(GLOSSY)
    radiance += added;
#endif
#ifdef FOG
    radiance = in_fog(radiance);
#endif
    colour = vec4(radiance, 1.0);
    drop_artefact();
}
#endif
