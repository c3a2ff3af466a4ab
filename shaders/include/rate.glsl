// Rate of change at a fixed pixel on a moving surface. A surface point moves by v px/s, so at the pixel the surface
// slides the other way: d/dt = -(v . grad) of anything interpolated over the surface.
//
// A perspective-correct varying times 1/w is linear on the screen, and so is 1/w: the differences of a pixel quad are
// then exact, and the quotient rule gives the exact gradient (the plain dFdx of the varying is half a pixel off).

// -(v . grad) of a varying, per second
vec3 seen_rate(vec3 value, vec2 v)
{
    float W = gl_FragCoord.w;
    vec3 scaled = value * W;
    return ((dFdx(scaled) - value * dFdx(W)) * v.x + (dFdy(scaled) - value * dFdy(W)) * v.y) / -W;
}

vec2 seen_rate(vec2 value, vec2 v)
{
    return seen_rate(vec3(value, 0.0), v).xy;
}

// Half the distance, px, over which a texture's rate is computed: short enough for steps of a fraction of a pixel, and
// far above the 1/256 texel to which GPUs round a sample's position.
const float REACH = 0.25;

// For the texture's used channels (CHANNELS), per second, by a central difference along the motion.
// every: px of the image per px of the target.
ALBEDO texture_rate(sampler2D image, vec2 uv, vec2 v, float every)
{
    float speed = length(v);
    if (!(speed > 0.0))
        return ALBEDO(0.0);
    vec2 along_x = seen_rate(uv, vec2(-1.0 / every, 0.0)), along_y = seen_rate(uv, vec2(0.0, -1.0 / every));
    // The surface comes from the direction opposite to the motion: the point REACH px back is seen next.
    vec2 aside = mat2(along_x, along_y) * (v / speed) * REACH;
    ALBEDO ahead = textureGrad(image, uv - aside, along_x, along_y).CHANNELS;
    ALBEDO behind = textureGrad(image, uv + aside, along_x, along_y).CHANNELS;
    return (ahead - behind) * speed * every * (0.5 / REACH);
}
