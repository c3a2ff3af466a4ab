#version 430 core
// A lens's picture from the pinhole picture (blinkgl/render/lens.py): the value nearest to each pixel's ray, or
// (SMOOTH) the mean over the pixel.
//
// OUTPUTS         OUTPUT(k, SAMPLER, TEXEL) for each output: its number, its sampler's type and its own
// COLUMNS, ROWS   SMOOTH: samples per pixel. Numbers computed per pixel would cost five times as much.

#include "cover.glsl"

#ifdef FRAGMENT_SHADER
uniform sampler2D places;   // position of each pixel's centre in the pinhole picture, px from its corner
uniform vec2 flat_size;     // size, px, of the pinhole picture that places refer to
#ifdef SMOOTH
uniform sampler2D slopes;   // d(place) / d(px), columns
#endif

#define OUTPUT(k, SAMPLER, TEXEL) uniform SAMPLER picked_##k; layout(location = k) out TEXEL out_##k;
OUTPUTS

void main()
{
    // Places are px of the pinhole picture; its target may have more samples.
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    vec2 size = vec2(textureSize(picked_0, 0)), scale = size / flat_size;
    vec2 place = texelFetch(places, pixel, 0).xy * scale;
#ifdef SMOOTH
    // As many samples as a pixel has pixels of the pinhole picture at most, each interpolated between four pixels, so
    // that each of those gets its share of the pixel's area.
    vec4 slope = texelFetch(slopes, pixel, 0);
    vec2 right = slope.xy * scale, down = slope.zw * scale;
    vec4 sum = vec4(0.0);
    for (int y = 0; y < ROWS; ++y)
        for (int x = 0; x < COLUMNS; ++x)
        {
            vec2 at = vec2(x, y) + 0.5;
            vec2 there = place + right * (at.x / float(COLUMNS) - 0.5) + down * (at.y / float(ROWS) - 0.5);
            sum += textureLod(picked_0, there / size, 0.0);
        }
    out_0 = sum / float(ROWS * COLUMNS);
#else
    ivec2 nearest = min(ivec2(place), ivec2(size) - 1);
#undef OUTPUT
#define OUTPUT(k, SAMPLER, TEXEL) out_##k = texelFetch(picked_##k, nearest, 0);
    OUTPUTS
#endif
}
#endif
