#version 430 core
// Event pass: linear luminance into one R32F target, nothing else (the event kernel takes the logarithm).
//
// Variants   TEXTURED   albedo luminance from a one-channel texture, else the uniform alone
//            LIT        Lambert, of the light of light.glsl: a white sun and sky; else unlit
//            TAPS4      four texture lookups per pixel instead of one, each one mip level finer
//            TWO_SIDED  the normal is turned towards the camera on back faces
//            RATE       (luminance, its rate of change per second at this pixel) into an RG32F target
//            EVERY n    the target holds every n-th pixel of the image: textures are filtered for the whole image's
//                       pixels
//            FOG        seen through fog, see fog.glsl
//            LIGHTS     more light than that, see lights.glsl; HUED: the albedo is r, g, b, each times its share of the
//                       luminance, since coloured light takes of each as much as it has
//            SHOW_LOOKUP  the shader debugger's: also writes what was looked up, see lookup.glsl

#if defined(RATE) && (defined(TEXTURED) || defined(LIT) || defined(FOG))
#define CHANGES
#endif

#ifdef TEXTURED
#define NEEDS_UV
#endif
#ifdef LIT
#define NEEDS_NORMAL
#endif
#if defined(CHANGES) || defined(LAMPS) || defined(SHADOWS)
#define NEEDS_LOCAL
#endif
#ifdef CHANGES
#define NEEDS_RATE
#ifdef LIT
#define NEEDS_NORMAL_RATE
#ifdef LAMPS
#define NEEDS_LOCAL_RATE
#endif
#endif
#endif
#ifdef HUED
#define ALBEDO vec3
#define CHANNELS rgb
#else
#define ALBEDO float
#define CHANNELS r
#endif
#include "vertex.glsl"

#ifdef FRAGMENT_SHADER
#ifdef SHOW_LOOKUP
#include "lookup.glsl"
#endif
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
#ifdef FOG
#include "fog.glsl"
#endif
#ifdef EVERY
const float every = float(EVERY);
#else
const float every = 1.0;
#endif
#ifdef TEXTURED
uniform sampler2D albedo;
#else
uniform float albedo;
#endif
#ifdef LIT
#include "light.glsl"
#endif
#include "guard.glsl"

void main()
{
#ifdef TEXTURED
    vec2 uv = within_reach(uv); // hides the varying
#ifdef TAPS4
    // At the centres of the pixel's four quarters, each filtered for a quarter: a box of two by two samples of the
    // texture.
    vec2 right = 0.25 * dFdx(uv), down = 0.25 * dFdy(uv);
    ALBEDO luminance = 0.25 * (texture(albedo, uv - right - down, -1.0).CHANNELS
                             + texture(albedo, uv + right - down, -1.0).CHANNELS
                             + texture(albedo, uv - right + down, -1.0).CHANNELS
                             + texture(albedo, uv + right + down, -1.0).CHANNELS);
#elif defined(EVERY)
    // Neighbours in the target are n px of the image apart; the level is chosen as if they were one.
    ALBEDO luminance = texture(albedo, uv, -log2(every)).CHANNELS;
#else
    ALBEDO luminance = texture(albedo, uv).CHANNELS;
#endif
#else
    ALBEDO luminance = albedo;
#endif
#ifdef LIT
#ifdef TWO_SIDED
    vec3 facing = gl_FrontFacing ? normal : -normal;
#else
    vec3 facing = normal;
#endif
    ILLUMINANT light = irradiance(facing);
#endif
#ifdef RATE
    ALBEDO change = ALBEDO(0.0);
#endif
#ifdef CHANGES
    vec2 motion = velocity(rate, local, image_size);
#ifdef TEXTURED
#ifdef TAPS4
    // One mip level finer is what every second pixel would see.
    change = 0.25 * (texture_rate(albedo, uv - right - down, motion, 2.0)
                   + texture_rate(albedo, uv + right - down, motion, 2.0)
                   + texture_rate(albedo, uv - right + down, motion, 2.0)
                   + texture_rate(albedo, uv + right + down, motion, 2.0));
#else
    change = texture_rate(albedo, uv, motion, every);
#endif
#endif
#ifdef LIT
    // L = albedo E(n): the product rule. ``luminance`` is still the albedo here, and the normal seen changes as the
    // surface slides by.
    vec3 facing_rate = seen_rate(facing, motion);
#ifdef DEFORM
    // and as the surface itself turns
#ifdef TWO_SIDED
    facing_rate += gl_FrontFacing ? normal_rate : -normal_rate;
#else
    facing_rate += normal_rate;
#endif
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
#endif
#ifdef SHOW_LOOKUP
#ifdef HUED
    float unlit = luminance.r + luminance.g + luminance.b;
    show_lookup(vec3(unlit), dot(luminance, light) / max(unlit, 1e-30));
#elif defined(LIT)
    show_lookup(vec3(luminance), light);
#else
    show_lookup(vec3(luminance), 1.0);
#endif
#endif
#ifdef LIT
    luminance *= light;
#endif
#ifdef HUED
    // The albedo has the luminance's weights in it.
    float seen = luminance.r + luminance.g + luminance.b;
#ifdef RATE
    float seen_change = change.r + change.g + change.b;
#endif
#else
#define seen luminance
#define seen_change change
#endif
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
