#version 430 core
// Event pass: linear luminance into one R32F target (the event kernel takes the logarithm).
//
// Variants   TEXTURED       albedo luminance from a one-channel texture, else the uniform alone
//            LIT            Lambert, of the light of light.glsl: a white sun and sky; else unlit
//            TAPS4          four texture lookups per pixel instead of one, each one mip level finer
//            STRETCHED      with TAPS4: the taps lie along the direction of foreshortening; NEAREST_LEVEL: each in one
//                           mip level
//            TWO_SIDED      the normal is turned towards the camera on back faces
//            RATE           (luminance, its rate of change per second at this pixel) into an RG32F target
//            EVERY n        the target holds every n-th pixel of the image: textures are filtered for the whole
//                           image's pixels
//            FOG            seen through fog, see fog.glsl
//            LIGHTS         other lights, see lights.glsl; RGB: the albedo is r, g, b, each times its share of the
//                           luminance, because coloured light scales each channel separately
//            TINTED         times the vertices' colours
//            EMISSIVE       emitted light, EMISSION_MAP: from a texture of its luminance
//            GLOSSY, BUMPED, GLOSS_MAP   see surface.glsl
//            MASKED         has holes, see vertex.glsl
//            SHOW_LOOKUP    for the shader debugger: also writes the texture lookups, see lookup.glsl

// CHANGES: the surface varies from pixel to pixel, so that its motion changes the luminance.
#if defined(RATE) && (defined(TEXTURED) || defined(LIT) || defined(FOG) || defined(TINTED))
#define CHANGES
#endif
#include "needs.glsl"
#ifdef CHANGES
#define NEEDS_RATE
#ifdef LIT
#define NEEDS_NORMAL_RATE
#if defined(LAMPS) || defined(GLOSSY)
#define NEEDS_LOCAL_RATE
#endif
#ifdef BUMPED
#define NEEDS_TANGENT_RATE
#endif
#endif
#endif
#include "vertex.glsl"

#ifdef FRAGMENT_SHADER
#if defined(SURFACED) || defined(EMISSION_MAP)
#include "maps.glsl"
#endif
#ifdef SHOW_LOOKUP
#include "lookup.glsl"
#endif
#include "albedo.glsl"
#ifdef RATE
layout(location = 0) out vec2 result;
#else
layout(location = 0) out float result;
#endif
#ifdef CHANGES
uniform vec2 image_size;
uniform mat4x3 rate;
#include "motion.glsl"
#include "rate.glsl"
#endif
#define EMITTED float
#include "sent.glsl"

void main()
{
#ifdef NEEDS_UV
    vec2 uv = within_reach(uv); // hides the varying
#endif
#ifdef TEXTURED
    ALBEDO luminance = albedo_at(uv);
#else
    ALBEDO luminance = albedo;
#endif
#ifdef RATE
    ALBEDO change = ALBEDO(0.0);
#endif
// Rate of the albedo: the texture slides by with the image motion.
#ifdef CHANGES
    vec2 motion = velocity(rate, local, image_size);
#ifdef TEXTURED
    change = texture_rate(albedo, uv, motion, every);
#endif
#endif
// The product rule on albedo and tint.
#ifdef TINTED
#ifdef CHANGES
    change = change * TINT(tint) + luminance * TINT(seen_rate(tint, motion));
#endif
    luminance *= TINT(tint);
#endif
    ALBEDO unlit = luminance;
// Light, and the product rule on albedo and light.
#ifdef LIT
#ifdef SURFACED
    float side = SIDE;
    Spot spot = Spot(unlit / WEIGHTS, normal, vec4(0.0), vec3(0.0), vec2(0.0));
#ifdef BUMPED
    spot.along = tangent;
#endif
#ifdef NEEDS_LOCAL
    spot.at = local;
#endif
#ifdef NEEDS_UV
    spot.coordinates = uv;
#endif
#if defined(EVERY) && !defined(RATE)
    map_bias = -log2(every);
#endif
#ifdef CHANGES
    // L of the whole surface, a little before and after.
    vec3 turn_rate = seen_rate(normal, motion), local_rate = seen_rate(local, motion);
    Spot spot_change = Spot(change / WEIGHTS, turn_rate, vec4(0.0), local_rate, vec2(0.0));
#ifdef BUMPED
    spot_change.along.xyz = seen_rate(tangent.xyz, motion);
#endif
#ifdef NEEDS_UV
    spot_change.coordinates = seen_rate(uv, motion);
    map_x = seen_rate(uv, vec2(-1.0 / every, 0.0));
    map_y = seen_rate(uv, vec2(0.0, -1.0 / every));
#endif
#ifdef DEFORM
    spot_change.normal += normal_rate; // and as the surface itself turns
#ifdef NEEDS_LOCAL_RATE
    spot_change.at += local_rate;
#endif
#ifdef BUMPED
    spot_change.along.xyz += tangent_rate;
#endif
#endif
#endif
    luminance = radiated(spot, side) * WEIGHTS;
#ifdef CHANGES
    change = radiated_rate(spot, spot_change, side, length(motion)) * WEIGHTS;
#endif
#elif defined(LIT_AT_CORNERS)
    luminance *= LIGHT_SEEN;
#else
    vec3 facing = TURNED(normal);
    ILLUMINANT light = irradiance(facing);
#ifdef CHANGES
    // L = albedo E(n): the product rule. ``luminance`` is still the albedo here, and the visible normal changes as
    // the surface slides by.
    vec3 facing_rate = seen_rate(facing, motion);
#ifdef DEFORM
    // and as the surface itself turns
    facing_rate += TURNED(normal_rate);
#endif
#ifdef LIGHTS
#ifdef LAMPS
    vec3 local_change = seen_rate(local, motion);
#ifdef DEFORM
    local_change += local_rate;
#endif
#else
    const vec3 local_change = vec3(0.0);
#endif
    change = change * light + luminance * irradiance_rate(facing, facing_rate, local_change);
#else
    change = change * light + luminance * irradiance_rate(facing, facing_rate);
#endif
#endif
    luminance *= light;
#endif
#endif
#ifdef RGB
    // The albedo includes the luminance's weights.
    float seen = luminance.r + luminance.g + luminance.b;
#ifdef RATE
    float seen_change = change.r + change.g + change.b;
#endif
#else
    float seen = luminance;
#ifdef RATE
    float seen_change = change;
#endif
#endif
// Emitted light is not multiplied by the albedo.
#ifdef EMISSIVE
#ifdef EMISSION_MAP
    vec2 emission_uv = emission_map_place * vec3(uv, 1.0);
#ifdef CHANGES
    seen_change += emission * texture_rate(emission_map, emission_uv, motion, every).r;
#endif
    float own = emission * map_at(emission_map, emission_uv, -log2(every)).r;
#else
    float own = emission;
#endif
#endif
// Only for the shader debugger: the terms of the light, as luminance on this surface.
#ifdef SHOW_LOOKUP
#ifdef SURFACED
    ILLUMINANT light = shown_matt;
#elif !defined(LIT)
    const float light = 1.0, shown_direct = 0.0, shown_arrives = 0.0, shown_around = 0.0;
#endif
#ifdef RGB
    float known = unlit.r + unlit.g + unlit.b;
#define OF_LUMINANCE(light) (dot(unlit, vec3(light)) / max(known, 1e-30))
#else
    float known = unlit;
#define OF_LUMINANCE(light) (light)
#endif
    float mirrored_light = 0.0, emitted = 0.0;
#ifdef GLOSSY
    mirrored_light = seen - known * OF_LUMINANCE(light);
#endif
#ifdef EMISSIVE
    emitted = own;
#endif
    show_lookup(vec3(known), vec3(light), OF_LUMINANCE(light), vec3(mirrored_light), vec3(emitted),
                OF_LUMINANCE(shown_direct), OF_LUMINANCE(shown_arrives), OF_LUMINANCE(shown_around));
#endif
#ifdef EMISSIVE
    seen += own;
#endif
// Fog comes last: it is between the surface and the camera.
#ifdef FOG
#ifdef CHANGES
    seen_change = in_fog_rate(seen, seen_change, motion);
#endif
    seen = in_fog(seen);
#endif
#ifdef RATE
    result = vec2(seen, finite(seen_change));
#else
    result = seen;
#endif
    drop_artefact();
}
#endif
