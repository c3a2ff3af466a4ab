// What the kernels of events share: the buffer whose head says how many pixels fire and how many events there are. (The
// first three words of each triple are read by indirect dispatches.)
struct Head {
    uint groups_of_pixels, groups_y, groups_z;
    uint groups_of_chunks, chunks_y, chunks_z;
    uint pixels; // that fire
    uint events;
    uint cut; // events that a block of 1024 pixels had too many
    uint chunks; // of 32 pixels that fire
    uint unusable; // a frame with values that cannot be used: nothing fires
    uint parts; // of 64 events that are sorted; an even number
    uint groups_of_parts, parts_y, parts_z;
    uint groups_of_digits, digits_y, digits_z;
    uint digit_chunks; // of 32 numbers, how often a digit is in a part
    uint spare;
};
const uint WORD = 32u, PER_GROUP = 256u, CHUNKS_PER_GROUP = 64u, PART = 64u;
