// What a surface sends out, for colour.glsl and luminance.glsl: emission (EMITTED: its type, of rgb or of luminance),
// the light on it, its gloss and maps, and fog before it.

#ifdef EMISSIVE
uniform EMITTED emission;
#ifdef EMISSION_MAP
uniform sampler2D emission_map; // of what emission is
uniform mat3x2 emission_map_place;
#endif
#endif
#if defined(LIT) && !defined(LIT_AT_CORNERS)
#include "light.glsl"
#endif
#ifdef SURFACED
#include "surface.glsl"
#endif
#ifdef FOG
#include "fog.glsl"
#endif
#include "guard.glsl"
