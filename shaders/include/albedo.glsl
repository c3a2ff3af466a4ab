// The albedo of luminance.glsl: a texture's, filtered in one of four ways, or the uniform; and a tint on it.
#ifdef RGB
#define ALBEDO vec3
#define CHANNELS rgb
#define WEIGHTS vec3(0.2126, 0.7152, 0.0722) // weights of the luminance, Rec. 709
#define TINT(colour) colour
#else
#define ALBEDO float
#define CHANNELS r
#define WEIGHTS 1.0
#define TINT(colour) dot(colour, tint_shares)
#ifdef TINTED
uniform vec3 tint_shares; // shares of r, g and b in the luminance of a tinted surface
#endif
#endif
#ifdef EVERY
const float every = float(EVERY);
#else
const float every = 1.0;
#endif

#ifndef TEXTURED
uniform ALBEDO albedo;
#else
uniform sampler2D albedo;

ALBEDO albedo_at(vec2 uv)
{
#ifdef TAPS4
    vec2 right = 0.25 * dFdx(uv), down = 0.25 * dFdy(uv);
#ifdef STRETCHED
    // The longer and the shorter side of the pixel on the surface: four taps in a square where they are similar, in a
    // row along the longer one at a grazing angle; each with the level that fits.
    vec2 texels = vec2(textureSize(albedo, 0));
    float across = dot(right * texels, right * texels), along = dot(down * texels, down * texels);
    if (across > along) {
        vec2 other = right;
        right = down;
        down = other;
        other.x = across;
        across = along;
        along = other.x;
    }
    float row = clamp(along / max(4.0 * across, 1e-3 * along + 1e-20) - 0.5, 0.0, 1.0);
    right = mix(right, 0.5 * down, row);
    // Squares of the spacing of the taps on the surface, two texels and one texel: half of log2 is the level.
    float level = 0.5 * log2(max(mix(4.0 * along, max(along, 16.0 * across), row), 1e-30));
#ifdef NEAREST_LEVEL
    // One level instead of the mean of two: the four taps blur the difference.
    level = floor(level + 0.5);
#endif
#define TAP(at) textureLod(albedo, at, level).CHANNELS
#else
    // At the centres of the pixel's four quarters, each filtered for a quarter: a box of two by two samples
    // of the texture.
#define TAP(at) texture(albedo, at, -1.0).CHANNELS
#endif
    return 0.25 * (TAP(uv - right - down) + TAP(uv + right - down) + TAP(uv - right + down) + TAP(uv + right + down));
#elif defined(EVERY)
    // Neighbours in the target are n px of the image apart; the level is chosen as for one.
    return texture(albedo, uv, -log2(every)).CHANNELS;
#else
    return texture(albedo, uv).CHANNELS;
#endif
}
#endif
