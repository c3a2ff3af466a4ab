// The vertex stage of every program that draws the scene, and what it hands to the fragment stage. All of them have to
// place a vertex at the same bits, or a pixel would show one surface to one pass and another one to the next.
//
// To be included once, outside of both stages, after the program has defined what of a vertex its fragment stage looks
// at:
//   NEEDS_UV      in vec2 uv      texture coordinates, times the material's scale
//   NEEDS_NORMAL  in vec3 normal  object frame, not normalised
//   NEEDS_LOCAL   in vec3 local   position, object frame

#ifdef VERTEX_SHADER
in vec3 in_position;
uniform mat4 mvp;
// The same bits whatever else the compiler makes of the stage: depths are compared between passes.
invariant gl_Position;
#ifdef NEEDS_UV
in vec2 in_uv;
out vec2 uv;
#endif
#ifdef NEEDS_NORMAL
in vec3 in_normal;
out vec3 normal;
#endif
#ifdef NEEDS_LOCAL
out vec3 local;
#endif

void main()
{
    gl_Position = mvp * vec4(in_position, 1.0);
#ifdef NEEDS_UV
    uv = in_uv;
#endif
#ifdef NEEDS_NORMAL
    normal = in_normal;
#endif
#ifdef NEEDS_LOCAL
    local = in_position;
#endif
}
#endif

#ifdef FRAGMENT_SHADER
#ifdef NEEDS_UV
in vec2 uv;
#endif
#ifdef NEEDS_NORMAL
in vec3 normal;
#endif
#ifdef NEEDS_LOCAL
in vec3 local;
#endif
#endif
