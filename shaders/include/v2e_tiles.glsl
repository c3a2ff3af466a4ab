// What sequences of a batch do not share, of V2E (tiles.glsl has ESIM's): uniforms of one sequence; with BATCH each has a tile,
// whole blocks of pixels that follow each other, and `here` is that of the invocation. (To be included last: the names are
// macros then.)
#ifdef BATCH
struct Tile {
    uint fires; // whether there is a new frame
    uint swapped; // which half of Both has it: the first one, or the second
    uint start_ns;
    uint share;
    uint scale, since, kappa, second_keep;
    uint second_ramp, number, bound, spare;
    uvec2 start, dt_ns, dt_whole, dt_s;
    uvec2 kappa_double, since_0, since_1, leak_jitter;
    uvec2 refractory_ns, seed, shot_unit, inverse_threshold;
};
layout(std140, binding = 1) uniform Tiles { Tile tiles[TILES]; };
uniform uint pixels_of_tile;
uniform uint height;
uniform uint length_of_half; // of Both, words
Tile here;
uint now_at, before_at; // where the halves begin

// The tile of a pixel, in which it has the number `pixel` from now on.
uint enter(inout uint pixel)
{
    uint tile = pixel / pixels_of_tile;
    pixel -= tile * pixels_of_tile;
    here = tiles[tile];
    now_at = here.swapped != 0u ? length_of_half : 0u;
    before_at = length_of_half - now_at;
    return tile;
}

#define start_ns here.start_ns
#define share here.share
#define scale here.scale
#define since here.since
#define kappa here.kappa
#define second_keep here.second_keep
#define second_ramp here.second_ramp
#define number here.number
#define bound here.bound
#define start here.start
#define dt_ns here.dt_ns
#define dt_whole here.dt_whole
#define dt_s here.dt_s
#define kappa_double here.kappa_double
#define since_0 here.since_0
#define since_1 here.since_1
#define leak_jitter here.leak_jitter
#define refractory_ns here.refractory_ns
#define seed here.seed
#define shot_unit here.shot_unit
#define inverse_threshold here.inverse_threshold
#define NOW_AT(I) both[now_at + (I)]
#define BEFORE_AT(I) both[before_at + (I)]
#else
uniform uint start_ns; // of the interval, after a whole microsecond
uniform uint share; // events that a block may have
uniform uint scale; // float: DN of luminance 1
uniform uint since; // float: seconds from the leak's epoch to the frame
uniform uint kappa; // float
uniform uint second_keep;
uniform uint second_ramp;
uniform uint number; // of the frame
uniform uint bound; // of a pixel's events, from the dead time
uniform uvec2 start; // of the interval, ns
uniform uvec2 dt_ns;
uniform uvec2 refractory_ns;
uniform uvec2 seed;
uniform uvec2 dt_whole; // dt_ns; doubles from here on
uniform uvec2 dt_s;
uniform uvec2 kappa_double;
uniform uvec2 since_0;
uniform uvec2 since_1;
uniform uvec2 leak_jitter;
uniform uvec2 shot_unit; // events per ns of a dark pixel with nominal thresholds, one polarity
uniform uvec2 inverse_threshold;
#define NOW_AT(I) now[I]
#define BEFORE_AT(I) before[I]
#endif
