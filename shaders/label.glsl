#version 430 core
// Label pass: any subset of the ground-truth buffers in one go. The renderer defines OUT_<NAME> as the attachment
// number for each buffer that somebody consumes; the others do not exist.
//
//   OUT_COLOUR    rgb linear radiance            OUT_DEPTH     Z along the optical axis, world units
//   OUT_ID        instance id (0: nothing hit)   OUT_NORMAL    unit normal, camera axes, facing it
//   OUT_VELOCITY  px/s (see SMALL)               OUT_FLOW_FORWARD, OUT_FLOW_BACKWARD
//                                                (u, v in px, Z at the other time; 0 in .w of unwritten pixels)
// SMALL: the target is a small picture of the image, whose pixels are image_scale px of the image apart; velocity is still the image's.
// Material variants as in luminance.glsl: TEXTURED, LIT, TWO_SIDED. SHOW_LOOKUP, the shader debugger's, goes with
// OUT_COLOUR 0: see lookup.glsl.

#if defined(OUT_COLOUR) && defined(LIT) || defined(OUT_NORMAL)
#define NEEDS_NORMAL
#endif
#if defined(OUT_VELOCITY) || defined(OUT_FLOW_FORWARD) || defined(OUT_FLOW_BACKWARD)
#define NEEDS_LOCAL
#endif
#if defined(OUT_COLOUR) && defined(TEXTURED)
#define NEEDS_UV
#endif

#include "vertex.glsl"

#ifdef FRAGMENT_SHADER
#ifdef SHOW_LOOKUP
#include "lookup.glsl"
#endif
#ifdef NEEDS_LOCAL
uniform vec2 image_size;
#include "motion.glsl"
#endif

#ifdef OUT_COLOUR
layout(location = OUT_COLOUR) out vec4 colour;
uniform vec3 base_color;
#ifdef TEXTURED
uniform sampler2D albedo;
#endif
#ifdef LIT
#include "light.glsl"
#endif
#endif
#ifdef OUT_DEPTH
layout(location = OUT_DEPTH) out float depth;
#endif
#ifdef OUT_ID
layout(location = OUT_ID) out uint id;
uniform uint instance_id;
#endif
#ifdef OUT_NORMAL
layout(location = OUT_NORMAL) out vec4 camera_normal;
uniform mat3 camera_from_local;
#endif
#ifdef OUT_VELOCITY
layout(location = OUT_VELOCITY) out vec2 image_velocity;
uniform mat4x3 rate;
#ifdef SMALL
uniform vec2 image_scale;
#endif
#endif
#ifdef OUT_FLOW_FORWARD
layout(location = OUT_FLOW_FORWARD) out vec4 flow_forward;
uniform mat4x3 difference_forward;
#endif
#ifdef OUT_FLOW_BACKWARD
layout(location = OUT_FLOW_BACKWARD) out vec4 flow_backward;
uniform mat4x3 difference_backward;
#endif
#include "guard.glsl"

void main()
{
#ifdef NEEDS_NORMAL
#ifdef TWO_SIDED
    vec3 facing = gl_FrontFacing ? normal : -normal;
#else
    vec3 facing = normal;
#endif
#endif
#ifdef OUT_COLOUR
    vec3 radiance = base_color;
#ifdef TEXTURED
    vec2 uv = within_reach(uv); // hides the varying
    radiance *= texture(albedo, uv).rgb;
#endif
#ifdef LIT
    float light = irradiance(facing);
#else
    const float light = 1.0;
#endif
#ifdef SHOW_LOOKUP
    show_lookup(radiance, light);
#endif
#ifdef LIT
    radiance *= light;
#endif
    colour = vec4(radiance, 1.0);
#endif
#ifdef OUT_DEPTH
    depth = 1.0 / gl_FragCoord.w;
#endif
#ifdef OUT_ID
    id = instance_id;
#endif
#ifdef OUT_NORMAL
    vec3 turned = camera_from_local * facing;
    camera_normal = vec4(turned * inversesqrt(max(dot(turned, turned), 1e-30)), 0.0); // zero stays zero, not NaN
#endif
#ifdef OUT_VELOCITY
    image_velocity = velocity(rate, local, image_size);
#ifdef SMALL
    image_velocity *= image_scale;
#endif
#endif
#ifdef OUT_FLOW_FORWARD
    flow_forward = vec4(displacement(difference_forward, local, image_size), 1.0);
#endif
#ifdef OUT_FLOW_BACKWARD
    flow_backward = vec4(displacement(difference_backward, local, image_size), 1.0);
#endif
    drop_artefact();
}
#endif
