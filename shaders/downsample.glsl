#version 430 core
// Box filter: mean of FACTOR x FACTOR texels of a super-sampled linear-light image.

#ifdef VERTEX_SHADER
void main()
{
    // One triangle that covers the screen, from the vertex number alone.
    gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.5, 1.0);
}
#endif

#ifdef FRAGMENT_SHADER
layout(location = 0) out vec4 mean_value;
uniform sampler2D fine;

void main()
{
    ivec2 corner = ivec2(gl_FragCoord.xy) * FACTOR;
    vec4 sum = vec4(0.0);
    for (int y = 0; y < FACTOR; ++y)
        for (int x = 0; x < FACTOR; ++x)
            sum += texelFetch(fine, corner + ivec2(x, y), 0);
    mean_value = sum / float(FACTOR * FACTOR);
}
#endif
