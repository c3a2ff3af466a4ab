#version 430 core
// Box filter: mean of FACTOR x FACTOR texels of a super-sampled linear-light image.

#include "cover.glsl"

#ifdef FRAGMENT_SHADER
layout(location = 0) out vec4 mean_value;
uniform sampler2D fine;

void main()
{
    // Texels of the fine picture for this pixel; texelFetch, so that no filter adds neighbours.
    ivec2 corner = ivec2(gl_FragCoord.xy) * FACTOR;
    vec4 sum = vec4(0.0);
    for (int y = 0; y < FACTOR; ++y)
        for (int x = 0; x < FACTOR; ++x)
            sum += texelFetch(fine, corner + ivec2(x, y), 0);
    mean_value = sum / float(FACTOR * FACTOR);
}
#endif
