// Image motion of a surface point from its object-local position, free of cancellation.
//
// With P the clip position now, D = (MVP' - MVP) composed in float64 and cast once, d = D * p and w' = w + d.w:
//   ndc' - ndc = (d.xy - ndc.xy * d.w) / w'
// Subtracting two projected positions instead (c1/w1 - c0/w0) leaves float32 rounding of the positions, 1e-4 px,
// in the result however small the motion is. ndc comes from gl_FragCoord, which is exact.

const float BEYOND = 1e37; // px, px/s: further than anything that is told apart from infinity

vec2 ndc_of_fragment(vec2 image_size)
{
    return gl_FragCoord.xy / image_size * 2.0 - 1.0;
}

// Of a shape that changes, q is in the place of p, and its own change comes on top: d = D * q + MVP' * (q' - q), the
// second term from the vertex stage.
//
// d: rows x, y, w.  Returns (u, v in px, w' in world units).  w' <= 0: behind the camera, or so near to its plane that the
// flow is beyond float32; u = v = 0 then.
vec3 displacement(vec3 d, vec2 image_size)
{
    float w_next = 1.0 / gl_FragCoord.w + d.z;
    vec2 flow = (d.xy - ndc_of_fragment(image_size) * d.z) / w_next * 0.5 * image_size;
    bool usable = w_next > 0.0 && max(abs(flow.x), abs(flow.y)) < BEYOND;
    return usable ? vec3(flow, w_next) : vec3(0.0, 0.0, min(w_next, 0.0));
}

// The same of a rigid body. difference: rows x, y, w of D.
vec3 displacement(mat4x3 difference, vec3 local, vec2 image_size)
{
    return displacement(difference * vec4(local, 1.0), image_size);
}

// In the limit: d(ndc)/dt = (d.xy - ndc.xy * d.w) / w with d = d(MVP)/dt * p (of a shape that changes: d(MVP)/dt * q + MVP *
// dq/dt); half the image is one unit of ndc.
// rate: rows x, y, w of d(MVP)/dt.  Returns px/s, at most BEYOND, whose square is infinite.
vec2 velocity(mat4x3 rate, vec3 local, vec2 image_size)
{
    vec3 d = rate * vec4(local, 1.0);
#if defined(DEFORM) && defined(NEEDS_RATE)
    d += shape_rate;
#endif
    vec2 v = (d.xy - ndc_of_fragment(image_size) * d.z) * gl_FragCoord.w * 0.5 * image_size;
    return clamp(v, -BEYOND, BEYOND);
}
