// The vertex stage of every program that draws the scene, and its outputs for the fragment stage. All programs must
// compute a vertex's position with the same bits; otherwise passes would show different surfaces at a pixel.
//
// Include it once, outside both stages, after the program has defined the vertex data that its fragment stage uses:
//   NEEDS_UV      in vec2 uv      texture coordinates, times the material's scale
//   NEEDS_NORMAL  in vec3 normal  object frame, not normalised
//   NEEDS_LOCAL   in vec3 local   position, object frame
//   NEEDS_TINT    in vec3 tint    the vertices' colours
//   NEEDS_TANGENT in vec4 tangent direction of a texture's u, object frame, of any length; 1 or -1 (tangents.py)
//
// MASKED, a surface with holes: is_hole(), which drop_artefact() of guard.glsl calls. TEXTURED, LIT: the material has a
// texture, and is lit; programs that draw neither ignore them.
//
// For a deforming shape (DEFORM, deform.glsl) all of these are at the present time, and in addition, in clip space,
// rows x, y, w:
//   NEEDS_RATE         in vec3 shape_rate      MVP dq/dt, per second
//   NEEDS_FORWARD      in vec3 shape_forward   MVP' (q' - q) of the time that forward flow leads to
//   NEEDS_BACKWARD     in vec3 shape_backward  the same of backward flow
//   NEEDS_NORMAL_RATE  in vec3 normal_rate     of ``normal``, object frame, per second
//   NEEDS_LOCAL_RATE   in vec3 local_rate      of ``local``: dq/dt, object frame, per second
//   NEEDS_TANGENT_RATE in vec3 tangent_rate    of ``tangent``, which turns as a normal does

#if defined(MASKED) && !defined(NEEDS_UV)
#define NEEDS_UV
#endif

// SHADOWS, for a LIT surface: shadow_place[SHADOWS] in SHADOW_PLACE, its position in each lamp's map, times w. It is
// affine in the object position, so interpolation is exact and saves two dot products per pixel and map.
#if defined(SHADOWS) && defined(LIT)
#ifdef SHADOW_SPOTS
#define SHADOW_PLACE vec4
#else
#define SHADOW_PLACE vec3
#endif
#endif

// LIT_AT_CORNERS (needs.glsl): flat in light_here, of the facet; TWO_SIDED: light_behind. LIGHT_SEEN:
// the visible side's.
#ifdef LIT_AT_CORNERS
#ifdef RGB
#define LIGHT_HERE vec3
#else
#define LIGHT_HERE float
#endif
#ifdef TWO_SIDED
#define LIGHT_SEEN (gl_FrontFacing ? light_here : light_behind)
#else
#define LIGHT_SEEN light_here
#endif
#endif

#ifdef VERTEX_SHADER
in vec3 in_position;
uniform mat4 mvp;
// The same bits in every program: depths are compared between passes.
invariant gl_Position;
#ifdef NEEDS_UV
in vec2 in_uv;
out vec2 uv;
#endif
#ifdef NEEDS_NORMAL
in vec3 in_normal;
out vec3 normal;
#endif
#ifdef NEEDS_LOCAL
out vec3 local;
#endif
#ifdef NEEDS_TINT
in vec3 in_tint;
out vec3 tint;
#endif
#ifdef NEEDS_TANGENT
in vec4 in_tangent;
out vec4 tangent;
#endif
#ifdef LIT_AT_CORNERS
in vec3 in_normal;
flat out LIGHT_HERE light_here;
#ifdef TWO_SIDED
flat out LIGHT_HERE light_behind;
#endif
#include "light.glsl"
#endif
#ifdef SHADOW_PLACE
uniform mat4 shadow_rows[SHADOWS]; // object frame to the map, by rows: x, y and depth in [0, 1], times w; and w
out SHADOW_PLACE shadow_place[SHADOWS];
#endif
#ifdef DEFORM
#include "deform.glsl"
#ifdef NEEDS_RATE
uniform mat3 clip_rate; // rows x, y, w of the linear part of MVP now
out vec3 shape_rate;
#endif
#ifdef NEEDS_FORWARD
uniform mat3 clip_forward; // of MVP'
out vec3 shape_forward;
#endif
#ifdef NEEDS_BACKWARD
uniform mat3 clip_backward;
out vec3 shape_backward;
#endif
#ifdef NEEDS_NORMAL_RATE
out vec3 normal_rate;
#endif
#ifdef NEEDS_LOCAL_RATE
out vec3 local_rate;
#endif
#ifdef NEEDS_TANGENT_RATE
out vec3 tangent_rate;
#endif
#endif

void main()
{
// Position first: every pass must get the same bits.
#ifdef DEFORM
    vec3 position = deformed(in_position);
#else
    vec3 position = in_position;
#endif
    gl_Position = mvp * vec4(position, 1.0);
#ifdef NEEDS_UV
    uv = in_uv;
#endif
#ifdef NEEDS_NORMAL
#ifdef DEFORM
    normal = deformed_normal(in_position, in_normal);
#else
    normal = in_normal;
#endif
#endif
#ifdef NEEDS_LOCAL
    local = position;
#endif
#ifdef LIT_AT_CORNERS
    light_here = irradiance(in_normal);
#ifdef TWO_SIDED
    light_behind = irradiance(-in_normal);
#endif
#endif
#ifdef SHADOW_PLACE
    for (int i = 0; i < SHADOWS; ++i)
        shadow_place[i] = SHADOW_PLACE(vec4(position, 1.0) * shadow_rows[i]);
#endif
#ifdef NEEDS_TINT
    tint = in_tint;
#endif
#ifdef NEEDS_TANGENT
#ifdef DEFORM
    tangent = vec4(deformed_normal(in_position, in_tangent.xyz), in_tangent.w);
#else
    tangent = in_tangent;
#endif
#endif
// Rates and changes of the shape, from its formula's derivatives and not from two positions.
#ifdef DEFORM
#ifdef NEEDS_RATE
    shape_rate = clip_rate * deformed_rate(in_position);
#endif
#ifdef NEEDS_FORWARD
    shape_forward = clip_forward * deformed_change(in_position, SHAPE_FORWARD);
#endif
#ifdef NEEDS_BACKWARD
    shape_backward = clip_backward * deformed_change(in_position, SHAPE_BACKWARD);
#endif
#ifdef NEEDS_NORMAL_RATE
    normal_rate = deformed_normal_rate(in_position, in_normal);
#endif
#ifdef NEEDS_LOCAL_RATE
    local_rate = deformed_rate(in_position);
#endif
#ifdef NEEDS_TANGENT_RATE
    tangent_rate = deformed_normal_rate(in_position, in_tangent.xyz);
#endif
#endif
}
#endif

#ifdef LENS_CLAIMS
#include "along_ray.glsl"
#endif

#ifdef FRAGMENT_SHADER
#ifndef LENS_CLAIMS // behind a lens they are values of along_ray.glsl
#ifdef NEEDS_UV
in vec2 uv;
#endif
#ifdef NEEDS_NORMAL
in vec3 normal;
#endif
#ifdef NEEDS_LOCAL
in vec3 local;
#endif
#ifdef LIT_AT_CORNERS
flat in LIGHT_HERE light_here;
#ifdef TWO_SIDED
flat in LIGHT_HERE light_behind;
#endif
#endif
#ifdef SHADOW_PLACE
in SHADOW_PLACE shadow_place[SHADOWS];
#endif
#ifdef NEEDS_TINT
in vec3 tint;
#endif
#ifdef NEEDS_TANGENT
in vec4 tangent;
#endif
#ifdef DEFORM
#ifdef NEEDS_RATE
in vec3 shape_rate;
#endif
#ifdef NEEDS_FORWARD
in vec3 shape_forward;
#endif
#ifdef NEEDS_BACKWARD
in vec3 shape_backward;
#endif
#ifdef NEEDS_NORMAL_RATE
in vec3 normal_rate;
#endif
#ifdef NEEDS_LOCAL_RATE
in vec3 local_rate;
#endif
#ifdef NEEDS_TANGENT_RATE
in vec3 tangent_rate;
#endif
#endif
#endif
#ifdef MASKED
uniform sampler2D coverage; // opacity over the coordinates of the base colour
uniform float cutoff;

// Always the finest level: a hole is a shape, which must be the same in all passes, shadow maps and the ray caster.
bool is_hole()
{
    return textureLod(coverage, uv, 0.0).r < cutoff;
}
#endif
#endif
