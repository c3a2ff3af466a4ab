// Fog between the camera and everything (blinkgl/scene/types.py: Fog): at a distance d from the camera's centre
//   L' = L T + F (1 - T),  T = exp(-density d)
// d is Z times the length of the pixel's ray (X, Y, Z) / Z, so that it does not change when the camera turns.
uniform vec2 fog;     // density per world unit, F
uniform vec4 fog_ray; // (X, Y) / Z of a fragment: gl_FragCoord.xy * fog_ray.xy + fog_ray.zw

float fog_ray_length()
{
    return length(vec3(gl_FragCoord.xy * fog_ray.xy + fog_ray.zw, 1.0));
}

float fog_transmittance()
{
    // gl_FragCoord.w is 1/Z, so the quotient is the distance d.
    return exp(-fog.x * fog_ray_length() / gl_FragCoord.w);
}

vec3 in_fog(vec3 radiance)
{
    return mix(vec3(fog.y), radiance, fog_transmittance());
}

float in_fog(float luminance)
{
    return mix(fog.y, luminance, fog_transmittance());
}

#ifdef CHANGES
// d(L')/dt = T (dL/dt - (L - F) density dd/dt), of the luminance without fog and its rate. At a fixed pixel depth
// changes because the surface approaches and because it slides by: with W = 1/Z, grad Z = -grad W / W^2.
float in_fog_rate(float luminance, float change, vec2 motion)
{
    float W = gl_FragCoord.w;
    float own = (rate * vec4(local, 1.0)).z;
#ifdef DEFORM
    own += shape_rate.z;
#endif
    float nearing = (own + (dFdx(W) * motion.x + dFdy(W) * motion.y) / (W * W)) * fog_ray_length();
    return fog_transmittance() * (change - (luminance - fog.y) * fog.x * nearing);
}
#endif
