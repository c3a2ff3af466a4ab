#version 430 core
#include "cover.glsl"
#ifdef FRAGMENT_SHADER
uniform usampler2D ids;
layout(location = 0) out float edge;
void main() {
    ivec2 here = ivec2(gl_FragCoord.xy), last = textureSize(ids, 0) - 1;
    uint own = texelFetch(ids, here, 0).r;
    uint beside = texelFetch(ids, min(here + ivec2(1, 0), last), 0).r;
    edge = own != beside ? 1.0 : 0.0;
}
#endif
