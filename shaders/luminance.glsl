#version 430 core
// Event pass: linear luminance into one R32F target, nothing else (the event kernel takes the logarithm).
//
// Variants   TEXTURED   albedo luminance from a one-channel texture, else the uniform alone
//            LIT        sun and sky Lambert, else unlit
//            TAPS4      four texture lookups per pixel instead of one, each one mip level finer
//            TWO_SIDED  the normal is turned towards the camera on back faces
//            RATE       (luminance, its rate of change per second at this pixel) into an RG32F target
//            EVERY n    the target holds every n-th pixel of the image: textures are filtered for the whole image's
//                       pixels
//            FOG        seen through fog, see fog.glsl
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
#ifdef CHANGES
#define NEEDS_LOCAL
#define NEEDS_RATE
#ifdef LIT
#define NEEDS_NORMAL_RATE
#endif
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
    float luminance = 0.25 * (texture(albedo, uv - right - down, -1.0).r + texture(albedo, uv + right - down, -1.0).r
                            + texture(albedo, uv - right + down, -1.0).r + texture(albedo, uv + right + down, -1.0).r);
#elif defined(EVERY)
    // Neighbours in the target are n px of the image apart; the level is chosen as if they were one.
    float luminance = texture(albedo, uv, -log2(every)).r;
#else
    float luminance = texture(albedo, uv).r;
#endif
#else
    float luminance = albedo;
#endif
#ifdef LIT
#ifdef TWO_SIDED
    vec3 facing = gl_FrontFacing ? normal : -normal;
#else
    vec3 facing = normal;
#endif
    float light = irradiance(facing);
#endif
#ifdef RATE
    float change = 0.0;
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
    change = change * light + luminance * irradiance_rate(facing, facing_rate);
#endif
#endif
#ifdef SHOW_LOOKUP
#ifdef LIT
    show_lookup(vec3(luminance), light);
#else
    show_lookup(vec3(luminance), 1.0);
#endif
#endif
#ifdef LIT
    luminance *= light;
#endif
#ifdef FOG
#ifdef CHANGES
    change = in_fog_rate(luminance, change, motion);
#endif
    luminance = in_fog(luminance);
#endif
#ifdef RATE
    result = vec2(luminance, finite(change));
#else
    result = luminance;
#endif
    drop_artefact();
}
#endif
