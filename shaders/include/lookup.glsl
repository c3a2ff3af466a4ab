// Texture lookups of a pass, for the shader debugger: included only by the variant SHOW_LOOKUP, which only
// tools/shader_debugger uses. Every later lookup in the pass's source is recorded with the coordinates and the level
// that it really uses.

layout(location = 1) out vec4 shown_lookup; // u, v (times uv_scale), mip level (before clamping), light
layout(location = 2) out vec4 shown_albedo; // the factor of the light; number of lookups
layout(location = 3) out vec4 shown_mirrored; // added to their product: mirrored light
layout(location = 4) out vec4 shown_emission; // and emitted light
layout(location = 5) out vec4 shown_terms; // of the light: lamps without shadows, share left by shadows, surroundings
layout(location = 6) out vec4 shown_light;    // r, g, b of the light

vec4 noted = vec4(0.0); // sum over the look-ups of (u, v, level, 1)

vec4 noted_texture(sampler2D image, vec2 at)
{
    noted += vec4(at, textureQueryLod(image, at).y, 1.0);
    return texture(image, at);
}

vec4 noted_texture(sampler2D image, vec2 at, float bias)
{
    noted += vec4(at, textureQueryLod(image, at).y + bias, 1.0);
    return texture(image, at, bias);
}

float noted_texture(sampler2DShadow map, vec3 at) // a shadow map is not an albedo
{
    return texture(map, at);
}

vec4 noted_texture_lod(sampler2D image, vec2 at, float level)
{
    noted += vec4(at, level, 1.0);
    return textureLod(image, at, level);
}

vec4 noted_texture_grad(sampler2D image, vec2 at, vec2 along_x, vec2 along_y)
{
    vec2 size = vec2(textureSize(image, 0));
    noted += vec4(at, log2(max(length(along_x * size), length(along_y * size))), 1.0);
    return textureGrad(image, at, along_x, along_y);
}

// Call once, when the albedo is known and before it is multiplied by the light.
// direct, arrives : of the lamps, without shadows and with them.   around : of the sky or panorama.
// seen : of the light, as luminance on this surface.
void show_lookup(vec3 unlit, vec3 light, float seen, vec3 mirrored, vec3 emission,
                 float direct, float arrives, float around)
{
    shown_mirrored = vec4(mirrored, 0.0);
    shown_emission = vec4(emission, 0.0);
    shown_terms = vec4(direct, direct > 0.0 ? arrives / direct : 1.0, around, 0.0);
    shown_lookup = vec4(noted.xyz / max(noted.w, 1.0), seen);
    shown_light = vec4(light, 0.0);
    shown_albedo = vec4(unlit, noted.w);
}

// From here on every lookup of the including source uses the functions above.
#define texture noted_texture
#define textureLod noted_texture_lod
#define textureGrad noted_texture_grad
