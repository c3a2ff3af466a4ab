uniform vec2 image_size; // of the target, px
