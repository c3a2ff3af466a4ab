#version 430 core
// 1 within REACH px of a pixel that shows another object, else 0.
#include "cover.glsl"

#ifdef FRAGMENT_SHADER
layout(location = 0) out uint edge;
uniform usampler2D ids;

void main()
{
    ivec2 here = ivec2(gl_FragCoord.xy), last = textureSize(ids, 0) - 1;
    uint id = texelFetch(ids, here, 0).r;
    edge = 0u;
    for (int y = -REACH; y <= REACH; ++y)
        for (int x = -REACH; x <= REACH; ++x)
            edge |= uint(texelFetch(ids, clamp(here + ivec2(x, y), ivec2(0), last), 0).r != id);
}
#endif
