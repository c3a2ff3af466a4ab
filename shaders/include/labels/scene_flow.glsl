// Displacement of the point in space until the other time, camera axes now, world units.
uniform mat4x3 change_in_space;
#ifdef DEFORM
uniform mat3 space_from_clip; // from differences in clip space at the other time, rows x, y, w, to camera axes now
#endif

vec4 label_scene_flow()
{
    vec3 d = change_in_space * vec4(local, 1.0);
#ifdef DEFORM
    d += space_from_clip * shape_forward;
#endif
    return vec4(d, 1.0);
}
