// Where on its surface a fragment is evaluated, for programs that write labels.
//
// Behind a lens (LENS_CLAIMS) that is where the ray of the one pixel of the lens's picture passes that will look at this
// fragment: up to half a pixel beside its centre (lens_claims, blinkgl/render/lens.py). On a triangle 1/w and everything
// that is interpolated, times 1/w, are linear on the screen, so that the differences of a pixel quad lead there exactly.
#ifdef LENS_CLAIMS
uniform sampler2D lens_claims; // px of the target from the fragment's centre to the ray
vec2 ray_shift;
float ray_inverse_depth;
#define INVERSE_DEPTH ray_inverse_depth
#define FRAGMENT_XY (gl_FragCoord.xy + ray_shift)

vec3 along_ray(vec3 value)
{
    vec3 scaled = value * gl_FragCoord.w;
    return (scaled + dFdx(scaled) * ray_shift.x + dFdy(scaled) * ray_shift.y) / ray_inverse_depth;
}

#define NEEDED(name) vec3 ray_##name;
#ifdef NEEDS_LOCAL
NEEDED(local)
#endif
#ifdef NEEDS_NORMAL
NEEDED(normal)
#endif
#ifdef DEFORM
#ifdef NEEDS_RATE
NEEDED(shape_rate)
#endif
#ifdef NEEDS_FORWARD
NEEDED(shape_forward)
#endif
#ifdef NEEDS_BACKWARD
NEEDED(shape_backward)
#endif
#endif

// First of all, in uniform control flow.
void look_along_ray()
{
    float W = gl_FragCoord.w;
    ray_shift = texelFetch(lens_claims, ivec2(gl_FragCoord.xy), 0).xy;
    ray_inverse_depth = W + dFdx(W) * ray_shift.x + dFdy(W) * ray_shift.y;
    if (!(ray_inverse_depth > 0.25 * W)) // beside a horizon, where a surface is seen along itself
    {
        ray_shift = vec2(0.0);
        ray_inverse_depth = W;
    }
#ifdef NEEDS_LOCAL
    ray_local = along_ray(local);
#endif
#ifdef NEEDS_NORMAL
    ray_normal = along_ray(normal);
#endif
#ifdef DEFORM
#ifdef NEEDS_RATE
    ray_shape_rate = along_ray(shape_rate);
#endif
#ifdef NEEDS_FORWARD
    ray_shape_forward = along_ray(shape_forward);
#endif
#ifdef NEEDS_BACKWARD
    ray_shape_backward = along_ray(shape_backward);
#endif
#endif
}
// From here on these are the surface's where the ray meets it.
#define local ray_local
#define normal ray_normal
#define shape_rate ray_shape_rate
#define shape_forward ray_shape_forward
#define shape_backward ray_shape_backward
#else
#define INVERSE_DEPTH gl_FragCoord.w
#define FRAGMENT_XY gl_FragCoord.xy
#endif
