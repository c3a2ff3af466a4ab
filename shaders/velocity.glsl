#version 430 core
// Velocity pass: image velocity, px/s, for the time sampling and the preview. SMALL: the target is a small
// picture whose pixels are image_scale px of the image apart; velocity is still the image's. LENS: it is that
// of a lens's picture.

#define NEEDS_LOCAL
#define NEEDS_RATE
#include "vertex.glsl"

#ifdef FRAGMENT_SHADER
layout(location = 0) out vec2 image_velocity;
uniform vec2 image_size;
uniform mat4x3 rate;
#if defined(SMALL) && !defined(LENS)
uniform vec2 image_scale;
#endif
#include "motion.glsl"
#include "guard.glsl"

void main()
{
    image_velocity = velocity(rate, local, image_size);
// motion.glsl uses the target's image_size: convert px of the small picture to px of the image.
#if defined(SMALL) && !defined(LENS)
    image_velocity *= image_scale;
#endif
    drop_artefact();
}
#endif
