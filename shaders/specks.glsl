#version 430 core
// Bodies smaller than a pixel, added to a picture of the others: a pixel gets the share of its square that a body
// covers.
//
// A body's portrait (passes/specks.py) is it alone, enlarged to PORTRAIT x PORTRAIT texels, negative where it is not.
//
// A vertex for each of the nine pixels around the body's middle; those that it does not cover, or that show something
// nearer, are left out.

#ifdef VERTEX_SHADER
in vec4 in_body;  // middle of its bounding sphere and the sphere's diameter, px of the target; depth (near / Z)
in ivec2 in_cell; // of its portrait
flat out vec4 light; // and in alpha the share of the pixel

uniform vec2 image_size;
uniform sampler2D portraits;
uniform sampler2D depths;

void main()
{
    gl_Position = vec4(2.0, 2.0, 0.0, 1.0); // outside
    light = vec4(0.0);
    vec2 pixel = floor(in_body.xy) + vec2(gl_VertexID % 3, gl_VertexID / 3) - 1.0;
    if (any(lessThan(pixel, vec2(0.0))) || any(greaterThanEqual(pixel, image_size)))
        return;
    if (texelFetch(depths, ivec2(pixel), 0).r > in_body.w)
        return;
    // Each texel is a square of the picture, of which a part lies in the pixel.
    float side = in_body.z / float(PORTRAIT), share = 0.0;
    vec3 sum = vec3(0.0);
    vec2 corner = in_body.xy - 0.5 * in_body.z - pixel; // of the portrait, from that of the pixel
    for (int y = 0; y < PORTRAIT; ++y)
        for (int x = 0; x < PORTRAIT; ++x) {
            vec2 low = corner + side * vec2(x, y);
            // Exactly its side where it is inside, however small.
            vec2 inside = max(min(vec2(side), min(1.0 - low, low + side)), 0.0);
            vec3 texel = texelFetch(portraits, in_cell * PORTRAIT + ivec2(x, y), 0).rgb;
            float part = texel.r < 0.0 ? 0.0 : inside.x * inside.y;
            share += part;
            sum += part * texel;
        }
    if (share == 0.0)
        return;
    gl_Position = vec4((pixel + 0.5) / image_size * 2.0 - 1.0, 0.5, 1.0);
    light = vec4(sum / share, share);
}
#endif

#ifdef FRAGMENT_SHADER
flat in vec4 light;
layout(location = 0) out vec4 result; // blended by its alpha

void main()
{
    result = light;
}
#endif
