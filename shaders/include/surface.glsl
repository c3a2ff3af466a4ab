// Radiance of a surface that is more than matt (docs/light.md; the float64 reference: radiated() in
// tools/shader_debugger/appearance.py). Included after light.glsl.
//
//   BUMPED      a normal map
//   GLOSSY      metal and roughness: GGX, height-correlated Smith, Schlick; energy of multiple reflections is added
//               to the mirrored light (energy) and removed from the scattered, so white under uniform light is white
//   GLOSS_MAP   both from a map
//
// With RATE the surface is evaluated twice more, a little before and after: everything is one smooth formula.
#ifdef RATE
#define MAP(map, at) map_at(map, map##_place * vec3(at, 1.0), mat2(map##_place) * map_x, mat2(map##_place) * map_y)
vec2 map_x, map_y; // d(uv) of a pixel to the right and downwards
#else
#define MAP(map, at) map_at(map, map##_place * vec3(at, 1.0), map_bias)
float map_bias = 0.0;
#endif

ILLUMINANT shown_matt; // radiance scattered by a white surface of this kind, without mirrored light

#ifdef BUMPED
uniform sampler2D bumps;
uniform mat3x2 bumps_place;
uniform float bump_scale;

// Of the interpolated normal and tangent of a surface's front.
vec3 bumped(vec3 normal, vec3 along, float hand, vec2 at)
{
    vec3 n = normal * inversesqrt(max(dot(normal, normal), 1e-30));
    // Tangent made orthogonal to the normal (Gram-Schmidt); cross(n, t) times its hand is the direction of v.
    vec3 t = along - n * dot(n, along);
    t *= inversesqrt(max(dot(t, t), 1e-30));
    vec3 bump = 2.0 * MAP(bumps, at).xyz - 1.0;
    bump.xy *= bump_scale;
    return t * bump.x + cross(n, t) * (hand < 0.0 ? -bump.y : bump.y) + n * bump.z;
}
#endif

#ifdef GLOSSY
const float SMOOTHEST = 0.05, DIELECTRIC = 0.04; // smallest roughness; reflectance of non-metals
uniform vec3 eye;      // the camera's centre, object frame
uniform mat3 to_world; // from the object's axes
uniform vec2 gloss;    // metallic, roughness
#ifdef GLOSS_MAP
uniform sampler2D gloss_map;
uniform mat3x2 gloss_map_place;
#endif
uniform sampler2D energy; // reflection of uniform light, over (cosine, roughness): F0 r + g; b: the mean of r + g
uniform sampler2D looks; // its direction, over the same: for two looks the fraction from the normal to the mirror
                                // direction, and roughness; energy's a: how much is the first one's (gloss.py, both())
// Radiance seen in a mirror, by longitude, latitude and roughness.
#ifdef RGB
uniform sampler3D surroundings;
#define SURROUNDINGS surroundings
#else
uniform sampler3D surrounding_luminance;
#define SURROUNDINGS surrounding_luminance
#endif
#ifdef MOVED
uniform vec3 eye_rate;
uniform mat3 to_world_rate;
#define EYE (eye + later * eye_rate)
#define TO_WORLD (to_world + later * to_world_rate)
#else
#define EYE eye
#define TO_WORLD to_world
#endif

#ifdef VARYING
uniform float around_factor; // of the surroundings' light, which changes over time
#else
const float around_factor = 1.0;
#endif

// Radiance from direction d, world axes, mirrored by a surface of this roughness.
ILLUMINANT mirrored(vec3 d, float roughness)
{
    float levels = float(textureSize(SURROUNDINGS, 0).z);
    vec2 at = vec2(0.5 - atan(d.y, d.x) * 0.15915494309, 0.5 - asin(clamp(d.z, -1.0, 1.0)) * 0.31830988618);
    vec4 radiance = map_at(SURROUNDINGS, vec3(at, (roughness * (levels - 1.0) + 0.5) / levels));
#ifdef RGB
    return radiance.rgb * around_factor;
#else
    return radiance.r * around_factor;
#endif
}

// Light that leaves after multiple reflections: F is the mean of Schlick's term, even that of the energy.
#define SEVERAL(F0, F, even) { F = F0 + (1.0 - F0) * (1.0 / 21.0); F = F * even / (1.0 - F * (1.0 - even)); }

ILLUMINANT shone(ILLUMINANT base, vec3 normal, vec3 at, vec2 coordinates)
{
    // Normal and view direction; material parameters, of the map where there is one.
    vec3 n = normal * inversesqrt(max(dot(normal, normal), 1e-30)), v = normalize(EYE - at);
    float metallic = gloss.x, roughness = gloss.y;
#ifdef GLOSS_MAP
    vec3 given = MAP(gloss_map, coordinates).rgb;
    metallic *= given.b;
    roughness *= given.g;
#endif
    roughness = max(roughness, SMOOTHEST);
    // GGX's alpha is roughness^2; square is alpha^2. cell: texture coordinates of texel centres in the tables.
    float facing_eye = clamp(dot(n, v), 1e-3, 1.0), square = roughness * roughness * roughness * roughness;
    vec2 cells = vec2(textureSize(energy, 0)), cell = (vec2(facing_eye, roughness) * (cells - 1.0) + 0.5) / cells;
    vec4 part = map_at(energy, cell, 0.0), look = map_at(looks, cell, 0.0);
    float lost = 1.0 / (part.r + part.g) - 1.0, clear;
    ILLUMINANT metal;
    // Multiple reflections between the facets return the energy that a single one loses (lost).
    SEVERAL(DIELECTRIC, clear, part.b)
    SEVERAL(base, metal, part.b)
    clear = 1.0 + clear * lost;
    metal = 1.0 + metal * lost;
    float even_clear = clear * (DIELECTRIC * part.r + part.g);
    ILLUMINANT even_metal = metal * (base * part.r + part.g);
    // Scattered light: the part that the dielectric's surface does not reflect. Metals scatter none.
    shown_matt = (1.0 - metallic) * (1.0 - even_clear) * irradiance(normal);
    ILLUMINANT sum = base * shown_matt;
    // Mirrored surroundings: two looks between the normal and the mirror direction, weighted by energy's a.
    vec3 up = TO_WORLD * n, away = TO_WORLD * reflect(-v, n);
    ILLUMINANT first = mirrored(normalize(mix(up, away, look.r)), look.g);
    ILLUMINANT second = mirrored(normalize(mix(up, away, look.b)), look.a);
    sum += mix(second, first, part.a) * mix(ILLUMINANT(even_clear), even_metal, metallic);
#if defined(SUNS) || defined(LAMPS)
    // Lamps: D V F of GGX with Smith's height-correlated visibility and Schlick's Fresnel term; pi is
    // in the strength.
    float seen = sqrt(facing_eye * facing_eye * (1.0 - square) + square);
#define LOBE(beam, share) \
    float facing = dot(n, beam.towards); \
    if (facing > 0.0) \
    { \
        vec3 h = normalize(beam.towards + v); \
        vec3 aside = cross(n, h); /* 1 - (n.h)^2 without cancellation */ \
        float edge = 1.0 - clamp(dot(v, h), 0.0, 1.0), narrow = dot(aside, aside) * (1.0 - square) + square; \
        edge = edge * edge * edge * edge * edge; \
        float lobe = square / (narrow * narrow) * 0.5 \
            / (facing * seen + facing_eye * sqrt(facing * facing * (1.0 - square) + square)); \
        ILLUMINANT of_metal = metal * (base + (1.0 - base) * edge); \
        float of_clear = clear * (DIELECTRIC + (1.0 - DIELECTRIC) * edge); \
        sum += lobe * facing * share * mix(ILLUMINANT(of_clear), of_metal, metallic) * beam.strength; \
    }
#endif
#ifdef SUNS
    for (int i = 0; i < SUNS; ++i)
    {
        Beam beam = sun_beam(i);
        float share = 1.0;
#ifdef SHADOW_SUNS
        if (i < SHADOW_SUNS)
            share = shadow_share[i];
#endif
        LOBE(beam, share)
    }
#endif
#ifdef LAMPS
    for (int i = 0; i < LAMPS; ++i)
    {
        Beam beam = lamp_beam(i, at);
        float share = 1.0;
#ifdef SHADOW_SPOTS
        int k = i - (LAMPS - SPOTS);
        if (k >= 0 && k < SHADOW_SPOTS)
            share = shadow_share[SHADOWS - SHADOW_SPOTS + k];
#endif
        LOBE(beam, share)
    }
#endif
    return sum;
}
#endif

// At a pixel: albedo, the front's interpolated normal and tangent, position in the object's axes, texture coordinates.
struct Spot
{
    ILLUMINANT base;
    vec3 normal;
    vec4 along;
    vec3 at;
    vec2 coordinates;
};

// side: -1 where the back is visible.
ILLUMINANT radiated(Spot spot, float side)
{
    vec3 normal = spot.normal;
#ifdef BUMPED
    normal = bumped(normal, spot.along.xyz, spot.along.w, spot.coordinates);
#endif
#ifdef GLOSSY
    return shone(spot.base, normal * side, spot.at, spot.coordinates);
#else
    shown_matt = irradiance(normal * side);
    return spot.base * shown_matt;
#endif
}

#ifdef MOVED
// Half the time between the two evaluations: a quarter of a pixel, a fraction of a highlight's width.
float pause(Spot spot, Spot change, float speed)
{
    // Rotation rates of directions, rad/s: of normals, suns, lamps and the eye. width: of a highlight.
    float turning = length(change.normal) * inversesqrt(max(dot(spot.normal, spot.normal), 1e-30)), width = 0.5;
#ifdef SUNS
    for (int i = 0; i < SUNS; ++i)
        turning += length(sun_towards_rate[i]);
#endif
#ifdef LAMPS
    for (int i = 0; i < LAMPS; ++i)
        turning += length(lamp_place_rate[i] - change.at) / max(length(lamp_place[i] - spot.at), 1e-3);
#endif
#ifdef GLOSSY
    turning += length(eye_rate - change.at) / max(length(eye - spot.at), 1e-3);
    width = max(gloss.y, SMOOTHEST) * max(gloss.y, SMOOTHEST);
#endif
    return 1.0 / max(speed * 4.0 + turning * 8.0 / width, 1e-3);
}

// d(radiated)/dt where the spot's data change by ``change`` per second at the pixel.
ILLUMINANT radiated_rate(Spot spot, Spot change, float side, float speed)
{
    float step = pause(spot, change, speed);
    local_seen = change.at;
    // A central difference: second order in step.
    ILLUMINANT ends[2];
    for (int i = 0; i < 2; ++i)
    {
        later = i == 0 ? -step : step;
        ends[i] = radiated(Spot(spot.base + later * change.base, spot.normal + later * change.normal,
                                spot.along + later * change.along, spot.at + later * change.at,
                                spot.coordinates + later * change.coordinates), side);
    }
    later = 0.0;
    return (ends[1] - ends[0]) * (0.5 / step);
}
#endif
