// Light on a surface, for the event pass, its rate and the colour pass (the float64 reference: received() in
// tools/shader_debugger/appearance.py). Without LIGHTS it is the white sun and sky (blinkgl/scene/types.py: Light):
//   E(n) = sun * max(0, n.s) + sky * (0.5 + 0.5 * n_up)
// where, with SHADOWS, the sun is multiplied by its visible fraction (shadows.glsl).
// n, s and up in the object's own frame, so that normals need no matrix.
#ifdef SHOW_LOOKUP
#define SHOW(term, light) shown_##term += light; // for the shader debugger, see lookup.glsl
#else
#define SHOW(term, light)
#endif
#ifdef LIGHTS
#include "lights.glsl"
#else
#define ILLUMINANT float
#ifdef SHOW_LOOKUP
float shown_direct = 0.0, shown_arrives = 0.0, shown_around = 0.0;
#endif
uniform vec3 sun_direction;  // s, object frame, unit
uniform vec3 up_direction;   // world z, object frame, unit
uniform vec2 light_strength; // (sun, sky)
#ifdef SHADOWS
#include "shadows.glsl"
float shadow_share; // visible fraction of the sun, set by irradiance()
#endif

float irradiance(vec3 normal)
{
    // normalize(), except that the normal of a degenerate triangle, zero, stays zero instead of becoming NaN.
    vec3 n = normal * inversesqrt(max(dot(normal, normal), 1e-30));
    float facing = max(0.0, dot(n, sun_direction)), direct = light_strength.x * facing;
    float around = light_strength.y * (0.5 + 0.5 * dot(n, up_direction));
    SHOW(direct, direct)
#ifdef SHADOWS
    shadow_share = facing > 0.0 ? shadow(0, n, facing, vec3(0.0)) : 1.0;
    direct *= shadow_share;
#endif
    SHOW(arrives, direct)
    SHOW(around, around)
    return direct + around;
}

#ifdef RATE
uniform vec3 sun_rate; // ds/dt and d(up)/dt, object frame, 1/s
uniform vec3 up_rate;

// dE/dt of the same where the visible normal changes by normal_rate per second.
float irradiance_rate(vec3 normal, vec3 normal_rate)
{
#ifdef SHADOWS
    float sun = light_strength.x * shadow_share; // whose own rate is not included
#else
    float sun = light_strength.x;
#endif
    float scale = inversesqrt(max(dot(normal, normal), 1e-30));
    vec3 n = normal * scale;
    // d(N/|N|)/dt = (N' - n (n.N')) / |N|; then the product rule on n.s and n.up, whose axes turn with the object.
    vec3 turn = (normal_rate - n * dot(n, normal_rate)) * scale;
    float facing = dot(n, sun_direction);
    return (facing > 0.0 ? sun * (dot(turn, sun_direction) + dot(n, sun_rate)) : 0.0)
         + light_strength.y * 0.5 * (dot(turn, up_direction) + dot(n, up_rate));
}
#endif
#endif
