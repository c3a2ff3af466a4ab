// Light of a scene that asks for more than a white sun and sky; blinkgl/scene/lights.py says what each lamp sends.
//
//   SUNS     number of suns           LAMPS    number of point and spot lights, SPOTS: the last of them are spot lights
//   AMBIENT  light from all around    HUED     of three channels; else of one, what the luminance of this material takes
//
// Everything is in the object's own frame, made from float64 poses, so that neither normals nor positions need a matrix.
// A lamp is a Beam at a point of the surface: whoever shades by more than Lambert's cosine asks for the same beams.
#ifdef HUED
#define ILLUMINANT vec3
#else
#define ILLUMINANT float
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
    return Beam(sun_towards[i], sun_strength[i]);
}
#endif

#ifdef LAMPS
const float NEAREST = 1e-3; // world units: what is nearer is lit as if it were this far
uniform vec3 lamp_place[LAMPS];
uniform ILLUMINANT lamp_strength[LAMPS];
uniform float lamp_fading[LAMPS]; // 1 / reach^4
#ifdef SPOTS
uniform vec3 spot_axis[SPOTS]; // unit, against the way it shines
uniform vec2 spot_cone[SPOTS]; // scale and offset of the cosine
#endif

Beam lamp_beam(int i, vec3 at)
{
    vec3 way = lamp_place[i] - at;
    float square = max(dot(way, way), NEAREST * NEAREST), inverse = inversesqrt(square);
    vec3 towards = way * inverse;
    float fall = inverse * inverse * max(0.0, 1.0 - square * square * lamp_fading[i]);
#ifdef SPOTS
    if (i >= LAMPS - SPOTS)
    {
        int k = i - (LAMPS - SPOTS);
        float share = clamp(dot(towards, spot_axis[k]) * spot_cone[k].x + spot_cone[k].y, 0.0, 1.0);
        fall *= share * share;
    }
#endif
    return Beam(towards, fall * lamp_strength[i]);
}
#endif

#ifdef AMBIENT
#ifdef HUED
#define BANDS 3
#else
#define BANDS 1
#endif
uniform mat4 around[BANDS]; // Q, symmetric: a white surface with normal n gives back (n, 1) Q (n, 1)

ILLUMINANT quadric(mat4 Q[BANDS], vec4 a, vec4 b)
{
#ifdef HUED
    return vec3(dot(a, Q[0] * b), dot(a, Q[1] * b), dot(a, Q[2] * b));
#else
    return dot(a, Q[0] * b);
#endif
}
#endif

// Of a Lambert surface. normal : object frame, of any length; ``local`` is where it is.
ILLUMINANT irradiance(vec3 normal)
{
    vec3 n = normal * inversesqrt(max(dot(normal, normal), 1e-30)); // zero stays zero
    ILLUMINANT sum = ILLUMINANT(0.0);
#ifdef AMBIENT
    sum += max(quadric(around, vec4(n, 1.0), vec4(n, 1.0)), 0.0);
#endif
#ifdef SUNS
    for (int i = 0; i < SUNS; ++i)
    {
        Beam beam = sun_beam(i);
        sum += max(0.0, dot(n, beam.towards)) * beam.strength;
    }
#endif
#ifdef LAMPS
    for (int i = 0; i < LAMPS; ++i)
    {
        Beam beam = lamp_beam(i, local);
        sum += max(0.0, dot(n, beam.towards)) * beam.strength;
    }
#endif
    return sum;
}

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
#ifdef AMBIENT
uniform mat4 around_rate[BANDS];
#endif

// dE/dt of the same where the normal seen changes by normal_rate and the place seen by at_rate per second.
ILLUMINANT irradiance_rate(vec3 normal, vec3 normal_rate, vec3 at_rate)
{
    float scale = inversesqrt(max(dot(normal, normal), 1e-30));
    vec3 n = normal * scale;
    vec3 turn = (normal_rate - n * dot(n, normal_rate)) * scale; // dn/dt, see light.glsl
    ILLUMINANT sum = ILLUMINANT(0.0);
#ifdef AMBIENT
    ILLUMINANT change = 2.0 * quadric(around, vec4(turn, 0.0), vec4(n, 1.0))
                      + quadric(around_rate, vec4(n, 1.0), vec4(n, 1.0));
    sum += change * step(ILLUMINANT(0.0), quadric(around, vec4(n, 1.0), vec4(n, 1.0))); // none where it is cut off
#endif
#ifdef SUNS
    for (int i = 0; i < SUNS; ++i)
        if (dot(n, sun_towards[i]) > 0.0)
            sum += (dot(turn, sun_towards[i]) + dot(n, sun_towards_rate[i])) * sun_strength[i];
#endif
#ifdef LAMPS
    for (int i = 0; i < LAMPS; ++i)
    {
        // E = s (n.d) f(|d|) a(c): the product rule, with d the way to the lamp and c the cosine at a spot light's axis.
        vec3 way = lamp_place[i] - local, way_rate = lamp_place_rate[i] - at_rate;
        float square = dot(way, way), facing = dot(n, way);
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
        }
#endif
        sum += rate * lamp_strength[i];
    }
#endif
    return sum;
}
#endif
