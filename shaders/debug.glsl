#version 430 core
// The shader debugger's own pass (tools/shader_debugger): what luminance.glsl and label.glsl compute on the way, and
// which primitive wrote the pixel. Generation never asks for this program. It shares light.glsl with them and repeats
// their vertex stage, so that it covers the same fragments.
//
//   OUT_UV        texture coordinates, times uv_scale
//   OUT_LOD       mip level that is sampled; the level before clamping, log2(texels per pixel)
//   OUT_ALBEDO    rgb as colour samples it, before the light
//   OUT_SHADE     (albedo's luminance as luminance.glsl samples it, irradiance factor)
//   OUT_TRIANGLE  gl_PrimitiveID + 1 within the part (0: nothing hit)
//   OUT_LOCAL     object-local position, part number + 1
//   OUT_WINDOW    gl_FragCoord
// Material variants as in luminance.glsl: TEXTURED, LIT, TWO_SIDED.

#ifdef VERTEX_SHADER
in vec3 in_position;
uniform mat4 mvp;
invariant gl_Position;
out vec3 local;
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
    local = in_position;
#ifdef TEXTURED
    uv = in_uv;
#endif
#ifdef LIT
    normal = in_normal;
#endif
}
#endif

#ifdef FRAGMENT_SHADER
layout(location = OUT_UV) out vec2 texture_coordinate;
layout(location = OUT_LOD) out vec2 level;
layout(location = OUT_ALBEDO) out vec4 albedo_colour;
layout(location = OUT_SHADE) out vec2 shade;
layout(location = OUT_TRIANGLE) out uint triangle;
layout(location = OUT_LOCAL) out vec4 local_position;
layout(location = OUT_WINDOW) out vec4 window;

in vec3 local;
uniform float part_number;
uniform vec3 base_color;
#ifdef TEXTURED
in vec2 uv;
uniform sampler2D albedo;
uniform sampler2D albedo_luminance;
#else
uniform float albedo_luminance;
#endif
#ifdef LIT
in vec3 normal;
#include "light.glsl"
#endif
#include "guard.glsl"

void main()
{
#ifdef TEXTURED
    texture_coordinate = uv;
    level = textureQueryLod(albedo, uv);
    albedo_colour = vec4(texture(albedo, uv).rgb * base_color, 1.0);
    shade.x = texture(albedo_luminance, uv).r;
#else
    texture_coordinate = vec2(0.0);
    level = vec2(0.0);
    albedo_colour = vec4(base_color, 1.0);
    shade.x = albedo_luminance;
#endif
#ifdef LIT
#ifdef TWO_SIDED
    shade.y = irradiance(gl_FrontFacing ? normal : -normal);
#else
    shade.y = irradiance(normal);
#endif
#else
    shade.y = 1.0;
#endif
    triangle = uint(gl_PrimitiveID) + 1u;
    local_position = vec4(local, part_number);
    window = gl_FragCoord;
    drop_artefact();
}
#endif
