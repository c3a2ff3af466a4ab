// Lights other than a white sun and sky; blinkgl/scene/lights.py defines the light of each lamp.
//
//   SUNS     number of suns           LAMPS    number of point and spot lights, SPOTS: the last of them are spot lights
//   AMBIENT  light of the surroundings    RGB     of three channels; else one, weighted for this material's luminance
//   SHADOWS  see shadows.glsl
//   SURFACED with RATE: everything ``later`` by this many seconds, to first order, for surface.glsl
//
// Everything is in the object's own frame, computed from float64 poses, so that neither normals nor positions need a
// matrix. A lamp gives a Beam at a point of the surface, for Lambert and for other reflections.
#ifdef RGB
#define ILLUMINANT vec3
#else
#define ILLUMINANT float
#endif
#ifdef SHOW_LOOKUP
ILLUMINANT shown_direct = ILLUMINANT(0.0), shown_arrives = ILLUMINANT(0.0), shown_around = ILLUMINANT(0.0);
#endif

#if defined(SURFACED) && defined(RATE)
#define MOVED
float later = 0.0;                 // s
vec3 local_seen = vec3(0.0);       // d(local)/dt at this pixel
#define NOW(name, i) (name[i] + later * name##_rate[i])
#else
#define NOW(name, i) name[i]
#endif

#ifdef RATE
// What turns and moves in the object's frame, per second.
#ifdef SUNS
uniform vec3 sun_towards_rate[SUNS];
#endif
#ifdef LAMPS
uniform vec3 lamp_place_rate[LAMPS];
#endif
#ifdef SPOTS
uniform vec3 spot_axis_rate[SPOTS];
#endif
#endif

#ifdef SHADOWS
#include "shadows.glsl"
float shadow_share[SHADOWS]; // of each lamp with a map, as irradiance() found it
#endif

struct Beam
{
    vec3 towards;        // the lamp, unit
    ILLUMINANT strength; // of a white surface that faces it
};

#ifdef SUNS
uniform vec3 sun_towards[SUNS];
uniform ILLUMINANT sun_strength[SUNS];

Beam sun_beam(int i)
{
    return Beam(NOW(sun_towards, i), sun_strength[i]);
}
#endif

#ifdef LAMPS
const float NEAREST = 1e-3; // world units: nearer points are lit as if they were this far
uniform vec3 lamp_place[LAMPS];
uniform ILLUMINANT lamp_strength[LAMPS];
uniform float lamp_fading[LAMPS]; // 1 / reach^4
#ifdef SPOTS
uniform vec3 spot_axis[SPOTS]; // unit, against the direction in which it shines
uniform vec2 spot_cone[SPOTS]; // scale and offset of the cosine
#endif

vec3 here()
{
#ifdef MOVED
    return local + later * local_seen;
#else
    return local;
#endif
}

Beam lamp_beam(int i, vec3 at)
{
    // Inverse square, faded to 0 at the lamp's reach by 1 - (d / reach)^4.
    vec3 way = NOW(lamp_place, i) - at;
    float square = max(dot(way, way), NEAREST * NEAREST), inverse = inversesqrt(square);
    vec3 towards = way * inverse;
    float fall = inverse * inverse * max(0.0, 1.0 - square * square * lamp_fading[i]);
#ifdef SPOTS
    if (i >= LAMPS - SPOTS)
    {
        int k = i - (LAMPS - SPOTS);
        float share = clamp(dot(towards, NOW(spot_axis, k)) * spot_cone[k].x + spot_cone[k].y, 0.0, 1.0);
        fall *= share * share;
    }
#endif
    return Beam(towards, fall * lamp_strength[i]);
}
#endif

#ifdef AMBIENT
#ifdef RGB
#define BANDS 3
#else
#define BANDS 1
#endif
// For a white surface with normal n: dot(even, (n, 1)), a uniform sky; for a panorama (AMBIENT 2) also a quadratic form
// of n: dot(squares, n n) + dot(mixed, n n.yzx); or, for one that is not smooth enough (AMBIENT 3), a quartic form,
// which includes the quadratic one: x^4 x²y² x³y xy³ x²yz, three of each.
uniform vec4 around_even[BANDS];
#if AMBIENT == 2
uniform vec3 around_squares[BANDS], around_mixed[BANDS];
#elif AMBIENT > 2
uniform vec3 around_fourth[5 * BANDS];
#endif
#ifdef RATE
uniform vec4 around_even_rate[BANDS];
#if AMBIENT == 2
uniform vec3 around_squares_rate[BANDS], around_mixed_rate[BANDS];
#elif AMBIENT > 2
uniform vec3 around_fourth_rate[5 * BANDS];
#endif
#endif

float around_band(int band, vec3 n)
// The form of one channel at n, see above for the terms.
{
    vec4 even = NOW(around_even, band);
    float sum = dot(even.xyz, n) + even.w;
#if AMBIENT == 2
    sum += dot(NOW(around_squares, band), n * n) + dot(NOW(around_mixed, band), n * n.yzx);
#elif AMBIENT > 2
    vec3 square = n * n, mixed = n * n.yzx;
    int k = 5 * band;
    vec3 by_square = NOW(around_fourth, k) * square + NOW(around_fourth, k + 1) * square.yzx;
    sum += dot(square, by_square + NOW(around_fourth, k + 2) * mixed)
         + dot(mixed, NOW(around_fourth, k + 3) * square.yzx + NOW(around_fourth, k + 4) * mixed.zxy);
#endif
    return sum;
}

ILLUMINANT ambient(vec3 n)
{
#ifdef RGB
    return vec3(around_band(0, n), around_band(1, n), around_band(2, n));
#else
    return around_band(0, n);
#endif
}
#endif

// Light on a Lambert surface. normal : object frame, of any length; ``local`` is its position.
ILLUMINANT irradiance(vec3 normal)
{
    vec3 n = normal * inversesqrt(max(dot(normal, normal), 1e-30)); // zero stays zero
    ILLUMINANT sum = ILLUMINANT(0.0);
// Surroundings; the fit may be below 0, light is not.
#ifdef AMBIENT
#if AMBIENT > 1
    sum += max(ambient(n), 0.0);
#else
    sum += ambient(n); // no sky is below 0
#endif
    SHOW(around, sum)
#endif
// Suns: Lambert's cosine, times the visible fraction from the shadow map. SHADOW_SUNS of them have a map.
#ifdef SUNS
    for (int i = 0; i < SUNS; ++i)
    {
        Beam beam = sun_beam(i);
        float facing = max(0.0, dot(n, beam.towards));
        SHOW(direct, facing * beam.strength)
#ifdef SHADOW_SUNS
        if (i < SHADOW_SUNS)
        {
#ifdef MOVED
            if (later == 0.0)
#endif
            // No lookup where the lamp does not shine.
            shadow_share[i] = facing > 0.0 ? shadow(i, n, facing, vec3(0.0)) : 1.0;
            facing *= shadow_share[i];
        }
#endif
        SHOW(arrives, facing * beam.strength)
        sum += facing * beam.strength;
    }
#endif
// Point and spot lights likewise; of spot lights the first SHADOW_SPOTS have a map, behind those of the suns.
#ifdef LAMPS
    for (int i = 0; i < LAMPS; ++i)
    {
        Beam beam = lamp_beam(i, here());
        float facing = max(0.0, dot(n, beam.towards));
        SHOW(direct, facing * beam.strength)
#ifdef SHADOW_SPOTS
        int k = i - (LAMPS - SPOTS);
        if (k >= 0 && k < SHADOW_SPOTS)
        {
            int map = SHADOWS - SHADOW_SPOTS + k;
            bool shines = facing > 0.0 && beam.strength != ILLUMINANT(0.0);
#ifdef MOVED
            if (later == 0.0)
#endif
            shadow_share[map] = shines ? shadow(map, n, facing, local - lamp_place[i]) : 1.0;
            facing *= shadow_share[map];
        }
#endif
        SHOW(arrives, facing * beam.strength)
        sum += facing * beam.strength;
    }
#endif
    return sum;
}

#if defined(RATE) && !defined(MOVED)
#ifdef AMBIENT
// The product rule on around_band, whose numbers turn with the object.
float around_band_rate(int band, vec3 n, vec3 turn)
{
    float rate = dot(around_even[band].xyz, turn) + dot(around_even_rate[band].xyz, n);
#if AMBIENT == 2
    rate += 2.0 * dot(around_squares[band], n * turn) + dot(around_squares_rate[band], n * n)
          + dot(around_mixed[band], turn * n.yzx + n * turn.yzx) + dot(around_mixed_rate[band], n * n.yzx);
#elif AMBIENT > 2
    vec3 square = n * n, mixed = n * n.yzx, square_rate = 2.0 * n * turn, mixed_rate = turn * n.yzx + n * turn.yzx;
    int k = 5 * band;
    rate += dot(around_fourth[k], 2.0 * square * square_rate) + dot(around_fourth_rate[k], square * square)
          + dot(around_fourth[k + 1], square_rate * square.yzx + square * square_rate.yzx)
          + dot(around_fourth_rate[k + 1], square * square.yzx)
          + dot(around_fourth[k + 2], square_rate * mixed + square * mixed_rate)
          + dot(around_fourth_rate[k + 2], square * mixed)
          + dot(around_fourth[k + 3], square_rate.yzx * mixed + square.yzx * mixed_rate)
          + dot(around_fourth_rate[k + 3], square.yzx * mixed)
          + dot(around_fourth[k + 4], mixed_rate * mixed.zxy + mixed * mixed_rate.zxy)
          + dot(around_fourth_rate[k + 4], mixed * mixed.zxy);
#endif
#if AMBIENT > 1
    rate *= step(0.0, around_band(band, n)); // none where it is clipped
#endif
    return rate;
}
#endif

// dE/dt of the same where the visible normal changes by normal_rate and the position by at_rate per second.
ILLUMINANT irradiance_rate(vec3 normal, vec3 normal_rate, vec3 at_rate)
{
    float scale = inversesqrt(max(dot(normal, normal), 1e-30));
    vec3 n = normal * scale;
    vec3 turn = (normal_rate - n * dot(n, normal_rate)) * scale; // dn/dt, see light.glsl
    ILLUMINANT sum = ILLUMINANT(0.0);
#ifdef AMBIENT
#ifdef RGB
    sum += vec3(around_band_rate(0, n, turn), around_band_rate(1, n, turn), around_band_rate(2, n, turn));
#else
    sum += around_band_rate(0, n, turn);
#endif
#endif
#ifdef SUNS
    for (int i = 0; i < SUNS; ++i)
    {
        float change = dot(n, sun_towards[i]) > 0.0 ? dot(turn, sun_towards[i]) + dot(n, sun_towards_rate[i]) : 0.0;
#ifdef SHADOW_SUNS
        if (i < SHADOW_SUNS)
            change *= shadow_share[i]; // whose own rate is not included
#endif
        sum += change * sun_strength[i];
    }
#endif
#ifdef LAMPS
    for (int i = 0; i < LAMPS; ++i)
    {
        // E = s (n.d) f(|d|) a(c): the product rule, with d the way to the lamp and c the cosine at a spot's axis.
        vec3 way = lamp_place[i] - local, way_rate = lamp_place_rate[i] - at_rate;
        float square = dot(way, way), facing = dot(n, way);
        // No rate where it does not shine, nor nearer than NEAREST, where the strength is constant.
        if (facing <= 0.0 || square <= NEAREST * NEAREST)
            continue;
        float along = dot(way, way_rate) / square; // of d|d|/dt / |d|
        float cube = inversesqrt(square) / square, fade = square * square * lamp_fading[i];
        if (fade >= 1.0)
            continue;
        float value = facing * cube, rate = (dot(turn, way) + dot(n, way_rate)) * cube - 3.0 * value * along;
        rate = rate * (1.0 - fade) - value * 4.0 * fade * along;
        value *= 1.0 - fade;
#ifdef SPOTS
        if (i >= LAMPS - SPOTS)
        {
            int k = i - (LAMPS - SPOTS);
            float inverse = inversesqrt(square), cosine = dot(way, spot_axis[k]) * inverse;
            float cosine_rate = (dot(way_rate, spot_axis[k]) + dot(way, spot_axis_rate[k])) * inverse - cosine * along;
            float share = clamp(cosine * spot_cone[k].x + spot_cone[k].y, 0.0, 1.0);
            float share_rate = share > 0.0 && share < 1.0 ? spot_cone[k].x * cosine_rate : 0.0;
            rate = rate * share * share + value * 2.0 * share * share_rate;
#ifdef SHADOW_SPOTS
            if (k < SHADOW_SPOTS)
                rate *= shadow_share[SHADOWS - SHADOW_SPOTS + k];
#endif
        }
#endif
        sum += rate * lamp_strength[i];
    }
#endif
    return sum;
}
#endif
