// The vertex stage of a pass over all pixels of its target: one covering triangle, from the vertex number alone.
#ifdef VERTEX_SHADER
void main()
{
    // (-1, -1), (3, -1), (-1, 3): corners of a triangle that contains all of NDC.
    gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.5, 1.0);
}
#endif
