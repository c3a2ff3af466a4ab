#version 430 core
// Silhouettes and creases of a picture that has one sample a pixel, as the pixels would have them that take the mean of
// their whole squares.
//
// A pixel's centre is inside of a surface or not: 1 or 0, where the mean over its square is a share in between. Their
// difference is a sum over the lines that bound the surface: each adds the area that lies between it and the square's
// own boundary as seen from the centre, signed. So corners, ends of lines and surfaces that are narrower than a pixel
// come out right, whatever the order of the lines, and blending has only to add.
//
// STEP 0 writes the changes, to be added; STEP 1 the least that the sum may be (FLOOR, a vec4), since where surfaces of very
// different brightness meet in one pixel, what the lines do not know of each other may take more away than there is.

#ifndef STEP
#define STEP 0
#endif
#ifndef FLOOR
#define FLOOR vec4(0.0)
#endif

#ifdef VERTEX_SHADER
in vec2 in_place;
uniform vec2 image_size;
#if STEP == 0
in vec3 in_start;
in vec3 in_end;
in float in_crease;
flat out vec3 start;
flat out vec3 end;
flat out float crease;
#endif

void main()
{
    gl_Position = vec4(in_place / image_size * 2.0 - 1.0, 0.5, 1.0);
#if STEP == 0
    start = in_start;
    end = in_end;
    crease = in_crease;
#endif
}
#endif

#ifdef FRAGMENT_SHADER
layout(location = 0) out vec4 result;

#if STEP != 0
void main()
{
    result = FLOOR;
}
#else
flat in vec3 start; // px and depth; the surface lies to the left of the way to the end (y points down)
flat in vec3 end;
flat in float crease;
uniform sampler2D picture;
uniform sampler2D depths;
uniform vec2 image_size;

const float HALF = 0.5;
// Of a line's depth (near / Z): by how much the pixel beside it may differ and still be of its surface, and how much
// nearer what is behind it may be where they meet.
const float SAME = 0.25;
const float NEARER = 0.001;
const int ALONG = 12; // px, less one
const float SNAP = 1.0 / 128.0; // px: rasterisers place corners on a grid of 1/256

ivec2 inside_picture(ivec2 pixel)
{
    return clamp(pixel, ivec2(0), ivec2(image_size) - 1);
}

// Where the ray from the centre leaves the square, along its boundary, in half sides: 8 all round.
float around(vec2 ray)
{
    if (ray == vec2(0.0)) // a line that ends in the centre itself
        return 0.0;
    if (abs(ray.x) >= abs(ray.y))
        return ray.y / ray.x + (ray.x > 0.0 ? 0.0 : 4.0);
    return (ray.y > 0.0 ? 2.0 : 6.0) - ray.x / ray.y;
}

void main()
{
    vec2 from = start.xy - gl_FragCoord.xy, way = end.xy - start.xy;
    // The part of the line that is in the square.
    vec2 safe = mix(way, vec2(1e-12), lessThan(abs(way), vec2(1e-12)));
    vec2 one = (-HALF - from) / safe, two = (HALF - from) / safe;
    vec2 first = min(one, two), last = max(one, two);
    float low = max(0.0, max(first.x, first.y)), high = min(1.0, min(last.x, last.y));
    if (!(low < high))
        discard;
    float depth = mix(start.z, end.z, 0.5 * (low + high));

    vec2 inwards = normalize(vec2(-way.y, way.x));
    float room = dot(inwards, -from); // of the centre, to the line: positive on the surface
    ivec2 here = ivec2(gl_FragCoord.xy), aside = ivec2(round(1.2 * inwards));
    ivec2 front = inside_picture(here + aside), back = inside_picture(here - aside);
    float own = texelFetch(depths, here, 0).r;
    float front_depth = texelFetch(depths, front, 0).r, back_depth = texelFetch(depths, back, 0).r;
    bool inside = room > 0.0;
    if (abs(room) < SNAP && crease < 0.5) // what was drawn there decides
        inside = abs(own - front_depth) < abs(own - back_depth);
    if (inside) {
        front = here;
        front_depth = own;
    } else {
        back = here;
        back_depth = own;
    }
    // Something else hides the line: what lies behind it, continued as a plane to the line, is nearer. (A floor that a body
    // stands on is nearer beside it, and is not where they meet.)
    float beyond = texelFetch(depths, inside_picture(back - aside), 0).r;
    float steps_off = clamp(inside ? 1.0 - room : -room, 0.0, 1.0);
    float continued = back_depth + (back_depth - beyond) * steps_off;
    if (crease > 0.5 ? !(abs(back_depth - depth) < SAME * depth)
                     : !(min(continued, back_depth) < depth * (1.0 + NEARER)))
        discard;
    // At corners, and where it is narrower than a pixel, the surface is only in some other pixel around; or in none of
    // those: it is then between all centres for a while, and seen further along.
    vec2 onwards = way / max(abs(way.x), abs(way.y));
    float further = (end.z - start.z) / max(abs(way.x), abs(way.y));
    // Of a plane that ends at the horizon the depth beside the line is another one altogether; continued, it is the line's.
    float within = texelFetch(depths, inside_picture(front + aside), 0).r;
    float reached = front_depth + (front_depth - within) * clamp(inside ? room : 1.0 + room, 0.0, 1.0);
    bool known = abs(front_depth - depth) < SAME * depth || abs(reached - depth) < SAME * depth;
    for (int k = 0; k < 8 + 2 * ALONG && !known; ++k) {
        int steps = k < 8 ? 0 : (k % 2 * 2 - 1) * (k / 2 - 2);
        ivec2 beside = inside_picture(
            k < 8 ? here + ivec2((k + k / 4) % 3, (k + k / 4) / 3) - 1
                  : ivec2(floor(gl_FragCoord.xy + float(steps) * onwards)));
        float expected = depth + float(steps) * further;
        known = abs(texelFetch(depths, beside, 0).r - expected) < SAME * expected;
        front = beside;
    }
    if (!known)
        discard;

    // The area between the line and the square's boundary: the triangle that it makes with the centre, less the square's
    // sector between the same rays.
    vec2 p = from + low * way, q = from + high * way;
    float turn = around(q) - around(p);
    turn -= 8.0 * round(turn / 8.0);
    if (inside != turn > 0.0 && abs(turn) > 2.0)
        turn += inside ? 8.0 : -8.0;
    float share = 0.5 * (p.x * q.y - p.y * q.x) - 0.125 * turn;
    result = share * (texelFetch(picture, front, 0) - texelFetch(picture, back, 0));
}
#endif
#endif
