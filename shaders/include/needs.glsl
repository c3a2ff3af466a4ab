// What a program that is lit takes of a vertex, by the variant of its material and of the light; to be included before
// vertex.glsl. SURFACED: light is no factor on the albedo alone, see surface.glsl.
#if defined(LIT) && (defined(GLOSSY) || defined(BUMPED))
#define SURFACED
#endif
// FACETED: of flat facets, whose corners have one normal. Where the light hangs on nothing else it is the same all over
// a facet, and the vertex stage's: a panorama's form of up to 57 numbers is then not evaluated at every pixel.
#if defined(FACETED) && defined(LIT) && defined(LIGHTS) && !defined(SURFACED) && !defined(SHADOWS) \
    && !defined(LAMPS) && !defined(RATE) && !defined(DEFORM) && !defined(SHOW_LOOKUP)
#define LIT_AT_CORNERS
#elif defined(LIT)
#define NEEDS_NORMAL
#endif
#if defined(TEXTURED) || defined(EMISSION_MAP) || defined(GLOSS_MAP) || defined(BUMPED)
#define NEEDS_UV
#endif
#ifdef TINTED
#define NEEDS_TINT
#endif
#ifdef BUMPED
#define NEEDS_TANGENT
#endif
#if defined(CHANGES) || defined(LAMPS) || defined(GLOSSY)
#define NEEDS_LOCAL
#endif

// The side that is seen: of TWO_SIDED surfaces either, towards which the normal is turned.
#ifdef TWO_SIDED
#define SIDE (gl_FrontFacing ? 1.0 : -1.0)
#define TURNED(way) (gl_FrontFacing ? (way) : -(way))
#else
#define SIDE 1.0
#define TURNED(way) (way)
#endif
