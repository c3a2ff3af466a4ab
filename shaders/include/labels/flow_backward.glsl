// u, v in px, Z at the other time; 0 in .w of pixels that nothing writes.
#include "image_size.glsl"
#include "motion.glsl"
uniform mat4x3 difference_backward;

vec4 label_flow_backward()
{
    return vec4(displacement(difference_backward, local, image_size), 1.0);
}
