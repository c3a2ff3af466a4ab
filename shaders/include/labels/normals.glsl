// Unit normal, camera axes, facing the camera.
uniform mat3 camera_from_local;

vec4 label_normals()
{
    vec3 turned = camera_from_local * facing();
    return vec4(turned * inversesqrt(max(dot(turned, turned), 1e-30)), 0.0); // zero stays zero, not NaN
}
