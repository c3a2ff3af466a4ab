// The place on its surface at which a fragment is evaluated, for programs that write labels.
//
// Behind a lens (LENS_CLAIMS) it is where the ray of the lens's pixel that reads this fragment passes: up to half a
// pixel beside its centre (lens_claims, blinkgl/render/lens.py). The ray, not the centre, also decides whether it is on
// this facet. So a geometry stage (GEOMETRY_STAGE) enlarges every triangle to all pixels that it touches, and passes on
// its true corners; the fragment finds where the ray meets the true triangle, and its depth there, and is discarded
// where it misses. Neighbours share a corner's bits and compute the same product with opposite signs, so no ray passes
// between them.
#ifdef LENS_CLAIMS

// What vertex.glsl gives, as F(type, name).
#ifdef NEEDS_UV
#define HAS_UV(F) F(vec2, uv)
#else
#define HAS_UV(F)
#endif
#ifdef NEEDS_NORMAL
#define HAS_NORMAL(F) F(vec3, normal)
#else
#define HAS_NORMAL(F)
#endif
#ifdef NEEDS_LOCAL
#define HAS_LOCAL(F) F(vec3, local)
#else
#define HAS_LOCAL(F)
#endif
#if defined(DEFORM) && defined(NEEDS_RATE)
#define HAS_RATE(F) F(vec3, shape_rate)
#else
#define HAS_RATE(F)
#endif
#if defined(DEFORM) && defined(NEEDS_FORWARD)
#define HAS_FORWARD(F) F(vec3, shape_forward)
#else
#define HAS_FORWARD(F)
#endif
#if defined(DEFORM) && defined(NEEDS_BACKWARD)
#define HAS_BACKWARD(F) F(vec3, shape_backward)
#else
#define HAS_BACKWARD(F)
#endif
#define HANDED_ON(F) HAS_UV(F) HAS_NORMAL(F) HAS_LOCAL(F) HAS_RATE(F) HAS_FORWARD(F) HAS_BACKWARD(F)

uniform vec2 target_size; // px of the flat picture

#ifdef GEOMETRY_SHADER
layout(triangles) in;
layout(triangle_strip, max_vertices = 4) out;
#define THROUGH(type, name) in type name[]; flat out type name##_0; flat out type name##_1; flat out type name##_2;
HANDED_ON(THROUGH)
// clip space, x, y, w; and z, which is the near plane's of all
flat out vec3 corner_0;
flat out vec3 corner_1;
flat out vec3 corner_2;
flat out float near_depth;

// Half a pixel, and a little for rounding.
const float ASIDE = 0.51;
// px: a corner so sharp that it would be moved further is cut off.
const float FARTHEST = 4.0;

// A corner at px from the picture's middle, with all that the fragment stage needs of the three true corners.
void corner_at(vec2 px)
{
#define COPY(type, name) name##_0 = name[0]; name##_1 = name[1]; name##_2 = name[2];
    HANDED_ON(COPY)
    corner_0 = gl_in[0].gl_Position.xyw;
    corner_1 = gl_in[1].gl_Position.xyw;
    corner_2 = gl_in[2].gl_Position.xyw;
    near_depth = gl_in[0].gl_Position.z;
    gl_Position = vec4(px / (0.5 * target_size), 0.5, 1.0);
    EmitVertex();
}

// The rectangle around the visible part of a triangle, with the triangle's orientation.
void rectangle(vec2 low, vec2 high, bool turned)
{
    vec2 most = 0.5 * target_size + 2.0;
    low = max(low - ASIDE, -most);
    high = min(high + ASIDE, most);
    if (any(greaterThanEqual(low, high)))
        return;
    corner_at(low);
    corner_at(turned ? vec2(low.x, high.y) : vec2(high.x, low.y));
    corner_at(turned ? vec2(high.x, low.y) : vec2(low.x, high.y));
    corner_at(high);
    EndPrimitive();
}

void main()
{
    vec3 c[3];
    for (int k = 0; k < 3; ++k)
        c[k] = gl_in[k].gl_Position.xyw;
    float near = gl_in[0].gl_Position.z;
    // All of it is before the near plane: nothing is visible.
    if (max(max(c[0].z, c[1].z), c[2].z) < near)
        return;
    vec2 half_size = 0.5 * target_size;
    if (min(min(c[0].z, c[1].z), c[2].z) < near)
    {
        // It crosses the near plane: the rectangle around the part beyond it.
        vec2 low = vec2(1e9), high = vec2(-1e9);
        for (int k = 0; k < 3; ++k)
        {
            vec3 a = c[k], b = c[(k + 1) % 3];
            if (a.z >= near)
            {
                low = min(low, a.xy / a.z * half_size);
                high = max(high, a.xy / a.z * half_size);
            }
            if ((a.z < near) != (b.z < near))
            {
                vec2 at = mix(a.xy, b.xy, (near - a.z) / (b.z - a.z)) / near * half_size;
                low = min(low, at);
                high = max(high, at);
            }
        }
        rectangle(low - 1.0, high + 1.0, dot(c[0], cross(c[1], c[2])) < 0.0);
        return;
    }
    vec2 p[3], outward[3];
    float away[3];
    for (int k = 0; k < 3; ++k)
        p[k] = c[k].xy / c[k].z * half_size;
    // Signed area in px: its sign is the triangle's orientation; outward: unit normals of its sides, px to move them.
    vec2 u = p[1] - p[0], v = p[2] - p[0];
    float turn = u.x * v.y - u.y * v.x;
    bool fits = turn != 0.0;
    for (int k = 0; k < 3; ++k)
    {
        vec2 along = p[(k + 1) % 3] - p[k];
        outward[k] = vec2(along.y, -along.x) / (length(along) * (turn < 0.0 ? -1.0 : 1.0));
        away[k] = ASIDE * (abs(outward[k].x) + abs(outward[k].y));
    }
    vec2 moved[3];
    for (int k = 0; k < 3; ++k)
    {
        int before = (k + 2) % 3;
        vec2 a = outward[before], b = outward[k];
        // Intersection of two moved sides: Cramer's rule on their two line equations.
        vec2 by = vec2(away[before] * b.y - away[k] * a.y, away[k] * a.x - away[before] * b.x);
        by /= a.x * b.y - a.y * b.x;
        fits = fits && max(abs(by.x), abs(by.y)) < FARTHEST; // NaN does not
        moved[k] = p[k] + by;
    }
    if (!fits)
    {
        rectangle(min(min(p[0], p[1]), p[2]), max(max(p[0], p[1]), p[2]), turn < 0.0);
        return;
    }
    for (int k = 0; k < 3; ++k)
        corner_at(moved[k]);
    EndPrimitive();
}
#endif

#ifdef FRAGMENT_SHADER
uniform sampler2D lens_claims; // px of the target from the fragment's centre to the ray; 9 where no pixel reads it
#define ON_FACET(type, name) flat in type name##_0; flat in type name##_1; flat in type name##_2; type name;
HANDED_ON(ON_FACET)
flat in vec3 corner_0;
flat in vec3 corner_1;
flat in vec3 corner_2;
flat in float near_depth;
vec2 ray_xy;
float ray_inverse_depth;
#define INVERSE_DEPTH ray_inverse_depth
#define FRAGMENT_XY ray_xy

// Product of a and b as seen from the ray, times their depths: the side of the edge on which it passes.
float beside(vec2 a, vec2 b)
{
    precise float side = a.x * b.y - a.y * b.x;
    return side;
}

// Call first.
void look_along_ray()
{
    vec2 shift = texelFetch(lens_claims, ivec2(gl_FragCoord.xy), 0).xy;
    if (shift.x > 1.0)
        discard;
    ray_xy = gl_FragCoord.xy + shift;
    vec2 ndc = ray_xy / target_size * 2.0 - 1.0;
    // Corners as seen along the ray: a corner on the ray is (0, 0). precise, so that neighbours get the same bits.
    precise vec2 q0 = corner_0.xy - corner_0.z * ndc;
    precise vec2 q1 = corner_1.xy - corner_1.z * ndc;
    precise vec2 q2 = corner_2.xy - corner_2.z * ndc;
    vec3 share = vec3(beside(q1, q2), beside(q2, q0), beside(q0, q1));
    float sum = share.x + share.y + share.z;
    if (!(all(greaterThanEqual(share, vec3(0.0))) || all(lessThanEqual(share, vec3(0.0)))) || sum == 0.0)
        discard;
    share /= sum;
    float depth = corner_0.z + share.y * (corner_1.z - corner_0.z) + share.z * (corner_2.z - corner_0.z);
    if (!(depth >= near_depth))
        discard;
    ray_inverse_depth = 1.0 / depth;
    gl_FragDepth = near_depth * ray_inverse_depth;
#define MEET(type, name) name = name##_0 + share.y * (name##_1 - name##_0) + share.z * (name##_2 - name##_0);
    HANDED_ON(MEET)
}
#endif
#else
#define INVERSE_DEPTH gl_FragCoord.w
#define FRAGMENT_XY gl_FragCoord.xy
#endif
