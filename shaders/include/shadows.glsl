// Fraction of a lamp that is visible from a surface point, from its shadow map (shadow.glsl): 1 all of it, 0 nothing.
//
//   SHADOW_SUNS, SHADOW_SPOTS   the first of the suns and of the spot lights have a map each, in this order
//   SHADOWS   their number, 1 to 4          SOFT   by the size of the lamp; else each edge is one texel wide
//
// Depth is reversed: larger means nearer to the lamp. The compared depth is moved towards the lamp by the change of the
// surface's own plane over the texels read, so that no surface shadows itself; it is not moved sideways, so that shadow
// edges stay in place.
#ifdef SOFT
uniform mat3 shadow_plane[SHADOWS];      // by rows: transform of a normal to the slope of its plane's depth in the map
#endif
uniform vec4 shadow_scale[SHADOWS];      // width of a texel: .x + .y w, world units; depth per world unit: .z (suns);
                                         // softening: a sun's angle, rad, or a lamp's diameter, world units: .w
#ifdef SOFT
#define SHADOW_MAP sampler2D
#else
uniform float facet_slope; // tangent of the angle between facets of the mesh and the normals that smooth them
#define SHADOW_MAP sampler2DShadow
#endif
uniform SHADOW_MAP shadow_map_0;
#if SHADOWS > 1
uniform SHADOW_MAP shadow_map_1;
#endif
#if SHADOWS > 2
uniform SHADOW_MAP shadow_map_2;
#endif
#if SHADOWS > 3
uniform SHADOW_MAP shadow_map_3;
#endif

const float SPARE = 0.25, FARTHEST = 16.0; // texels towards the lamp: always, and at most (grazing light)

#ifdef SOFT
const float WIDEST = 24.0; // texels, radius of the search
const int TAPS = 16;

const float ANGLE = 2.39996323;
const vec2 TURN = vec2(cos(ANGLE), sin(ANGLE));

// Sunflower points in a disc of radius 1; the same for every pixel, because noise would cause events.
vec2 seed(int i)
{
    float angle = float(i) * ANGLE;
    return sqrt((float(i) + 0.5) / float(TAPS)) * vec2(cos(angle), sin(angle));
}

// A comparison at the four texels around, weighted bilinearly, as sampler2DShadow does.
float nearer(SHADOW_MAP map, vec2 at, float depth)
{
    vec2 size = vec2(textureSize(map, 0)), f = fract(at * size - 0.5);
    vec4 lit = vec4(greaterThanEqual(vec4(depth), textureGather(map, at))); // (0, 1), (1, 1), (1, 0), (0, 0)
    return mix(mix(lit.w, lit.z, f.x), mix(lit.x, lit.y, f.x), f.y);
}

// at: position of the point in the map; slope: of its plane's depth there; unit, texel: depth and width of one.
float seen_share(SHADOW_MAP map, vec3 at, vec2 slope, float unit, float texel, vec4 scale)
{
    // Smallest and largest offset towards the lamp that avoids self-shadowing, as depth.
    vec2 one = 1.0 / vec2(textureSize(map, 0));
    float most = FARTHEST * texel * unit, least = dot(abs(slope), one) + SPARE * texel * unit;
    bool sun = scale.z > 0.0;
    // Blockers, and their mean distance: for a sun within a cone, for a lamp within the cone of its disc.
    float reach = sun ? scale.w * (1.0 - at.z) / scale.z : scale.w, sum = 0.0, count = 0.0;
    vec2 search = clamp(0.5 * reach / texel, 1.0, WIDEST) * one;
    for (int i = 0; i < TAPS; i += 2)
    {
        vec2 aside = seed(i) * search;
        float there = texelFetch(map, ivec2((at.xy + aside) / one), 0).r; // outside: 0, nothing
        if (there > max(at.z + clamp(least + dot(slope, aside), -most, most), 0.0))
        {
            sum += there;
            count += 1.0;
        }
    }
    // llvmpipe executes both sides of an if, and a loop of known length; this one ends with the last pixel.
    int taps = count > 0.0 ? TAPS : 0;
    float blocker = sum / max(count, 1.0);
    // The penumbra's width: the sun's angle times the distance to the blocker, or by similar triangles from
    // the lamp's width.
    float width = sun ? scale.w * (blocker - at.z) / scale.z : scale.w * max(blocker / at.z - 1.0, 0.0);
    vec2 radius = clamp(0.5 * width / texel, 0.5, WIDEST) * one;
    float lit = 0.0;
    vec2 way = vec2(1.0, 0.0); // seed(i), by rotation
    for (int i = 0; i < taps; ++i)
    {
        vec2 aside = sqrt((float(i) + 0.5) / float(TAPS)) * way * radius;
        lit += nearer(map, at.xy + aside, max(at.z + clamp(least + dot(slope, aside), -most, most), 0.0));
        way = mat2(TURN.x, TURN.y, -TURN.y, TURN.x) * way;
    }
    return taps > 0 ? lit / float(TAPS) : 1.0;
}
#endif

// For map k and a surface with unit normal n; its position in the map comes from the vertex stage (``shadow_place``).
// facing: n.l > 0. aside: from the lamp to the surface, for a spot light. Beside a map there are no blockers.
float shadow(int k, vec3 n, float facing, vec3 aside)
{
    vec4 scale = shadow_scale[k];
    vec3 c = shadow_place[k].xyz;
    float texel = scale.x, unit = scale.z;
#ifdef SHADOW_SPOTS
    float w = 1.0;
    if (scale.z == 0.0) // a spot light's: perspective; depth is near / Z, which is affine in its picture, too
    {
        w = max(shadow_place[k].w, 1e-6);
        c /= w;
        texel = scale.y * w;
        unit = c.z / w;
    }
#endif
// The slope of the surface's plane in the map: change of depth per unit of each map coordinate.
#ifdef SOFT
    float through = dot(shadow_plane[k][2], n);
#ifdef SHADOW_SPOTS
    through = scale.z == 0.0 ? dot(n, aside) / (w * w) : through;
#endif
    through = abs(through) > 1e-4 ? through : 1e-4;
    vec2 slope = vec2(dot(shadow_plane[k][0], n), dot(shadow_plane[k][1], n)) * (unit / through);
#define SEEN(map) seen_share(map, c, slope, unit, texel, scale)
#else
    // The four texels that an edge is smoothed over are up to one away in x and y, together at most sqrt(2) slopes.
    float slant = sqrt(max(1.0 - facing * facing, 0.0)) / facing;
    // The facets themselves are steeper than the normals that are smoothed over them: tan of the sum of both angles.
    slant = slant * facet_slope < 1.0 ? (slant + facet_slope) / (1.0 - slant * facet_slope) : FARTHEST;
    c.z = max(c.z + min(1.5 * slant + SPARE, FARTHEST) * texel * unit, 0.0); // 0: behind all that casts
#define SEEN(map) texture(map, c)
#endif
// Every map is a sampler of its own, which needs a branch of its own.
#if SHADOWS > 3
    if (k == 3)
        return SEEN(shadow_map_3);
#endif
#if SHADOWS > 2
    if (k == 2)
        return SEEN(shadow_map_2);
#endif
#if SHADOWS > 1
    if (k == 1)
        return SEEN(shadow_map_1);
#endif
    return SEEN(shadow_map_0);
}
