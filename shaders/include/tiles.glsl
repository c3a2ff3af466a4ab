// What sequences of a batch do not share. Of one sequence these are uniforms; with BATCH each has a tile, whole blocks of
// pixels that follow each other, and `here` is that of the invocation. (To be included last: the names are macros then.)
#ifdef BATCH
struct Tile {
    uint fires; // whether there is a new frame
    uint swapped; // whether that lies in the buffer "before", and the last one in "now"
    uint start_ns;
    uint share;
    uvec2 dt_ns, base_ns;
    uvec2 refractory_ns, seed;
    ivec2 steps, floors;
    uvec2 jitter;
    float eps;
    uint spare;
};
layout(std140, binding = 1) uniform Tiles { Tile tiles[TILES]; };
uniform uint pixels_of_tile;
uniform uint height;
Tile here;

// The tile of a pixel, in which it has the number `pixel` from now on.
uint enter(inout uint pixel)
{
    uint tile = pixel / pixels_of_tile;
    pixel -= tile * pixels_of_tile;
    here = tiles[tile];
    return tile;
}

#define start_ns here.start_ns
#define share here.share
#define dt_ns here.dt_ns
#define base_ns here.base_ns
#define refractory_ns here.refractory_ns
#define seed here.seed
#define steps here.steps
#define floors here.floors
#define jitter here.jitter
#define eps here.eps
#else
uniform uint start_ns; // of the interval, after a whole microsecond
uniform uint share; // events that a block may have
uniform uvec2 dt_ns;
uniform uvec2 base_ns; // that microsecond
uniform uvec2 refractory_ns;
uniform uvec2 seed;
uniform ivec2 steps; // ON and OFF threshold
uniform ivec2 floors; // of thresholds with jitter
uniform uvec2 jitter; // double
uniform float eps;
#endif
