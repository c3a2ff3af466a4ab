// u, v in px, Z at the other time; 0 in .w of pixels that nothing writes.
#include "image_size.glsl"
#include "displacement.glsl"
uniform mat4x3 difference_backward;

vec4 label_flow_backward()
{
    vec3 d = difference_backward * vec4(local, 1.0); // d.z is the w row
// The motion of a deforming shape is added.
#ifdef DEFORM
    d += shape_backward;
#endif
    return vec4(displacement(d, image_size), 1.0);
}
