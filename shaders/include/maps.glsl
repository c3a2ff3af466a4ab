// Lookups other than the albedo, for surface.glsl: include before lookup.glsl, which would record them.
vec4 map_at(sampler2D map, vec2 at, float bias)
{
    return texture(map, at, bias);
}

vec4 map_at(sampler2D map, vec2 at, vec2 along_x, vec2 along_y)
{
    return textureGrad(map, at, along_x, along_y);
}

vec4 map_at(sampler3D map, vec3 at)
{
    return textureLod(map, at, 0.0);
}
