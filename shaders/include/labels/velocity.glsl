// Image velocity, px/s.
#include "image_size.glsl"
#include "motion.glsl"
uniform mat4x3 rate;

vec2 label_velocity()
{
    return velocity(rate, local, image_size);
}
