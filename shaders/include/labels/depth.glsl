// Z along the optical axis, world units; 0 in pixels that nothing writes.
float label_depth()
{
    return 1.0 / INVERSE_DEPTH;
}
