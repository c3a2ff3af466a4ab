// Vertex data that a lit program uses, by the variant of its material and of the light; include it before vertex.glsl.
// SURFACED: light is not only a factor on the albedo, see surface.glsl.
#if defined(LIT) && (defined(GLOSSY) || defined(BUMPED))
#define SURFACED
#endif
// FACETED: of flat facets, whose corners have one normal. Where the light depends only on the normal it is constant on
// a facet and computed in the vertex stage: a panorama's form of up to 57 numbers is then not evaluated at every pixel.
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

// The visible side: for TWO_SIDED surfaces either one; the normal is turned towards it.
#ifdef TWO_SIDED
#define SIDE (gl_FrontFacing ? 1.0 : -1.0)
#define TURNED(way) (gl_FrontFacing ? (way) : -(way))
#else
#define SIDE 1.0
#define TURNED(way) (way)
#endif
