// Unit normal, camera axes, facing the camera: one that is smoothed beyond the silhouette is bent back to it.
uniform mat4 camera_from_local;

vec4 label_normals()
{
    vec3 turned = mat3(camera_from_local) * facing(), ray = normalize((camera_from_local * vec4(local, 1.0)).xyz);
    turned *= inversesqrt(max(dot(turned, turned), 1e-30)); // zero stays zero, not NaN
    turned -= max(dot(turned, ray) + 1e-4 * dot(turned, turned), 0.0) * ray;
    return vec4(turned * inversesqrt(max(dot(turned, turned), 1e-30)), 0.0);
}
