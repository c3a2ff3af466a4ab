#version 430 core
// Silhouettes and creases of a picture with one sample per pixel: pixels on them get the mean over their square.
//
// A pixel's centre is inside a surface or not: 1 or 0, while the mean over its square is a share in between. Their
// difference is a sum over the lines that bound the surface: each adds the area between it and the square's own
// boundary as seen from the centre, signed. So corners, ends of lines and surfaces narrower than a pixel are correct,
// for any order of the lines.
//
// An outline of triangles smaller than a pixel is a zigzag: some of its lines run back, and their shares cancel those
// of others. So all lines of a pixel must use the same two surfaces as "in front" and "behind", in either direction:
// those that the depth buffer shows around the pixel, before and behind the line's depth.
//
// contours.py computes which lines cross which pixels, and their shares. Here one vertex and one point are drawn for
// each crossed pixel, so that its neighbours are read once for any number of lines.
//
// LIGHT: the type of a pixel's value, OF: its components in the picture. The sum is at least 0, because lines of
// different surfaces may together subtract more than there is.

#ifndef LIGHT
#define LIGHT vec4
#define OF rgba
#endif

#ifdef VERTEX_SHADER
in ivec4 in_pixel; // its position; the first of its crossings and the one after the last
flat out vec4 light;

uniform vec2 image_size;
uniform float pixel; // 1 / focal length, px
uniform sampler2D picture;
uniform sampler2D depths;
uniform sampler2D crossings;

// Relative differences of depth (near / Z). The first two are in widths of a pixel at the surface, because a body of a
// few pixels is curved by that much: farther than GAP lies behind; nearer than COVER hides the line, unless the pixel's
// centre is on its surface, which may be nearer by SAME. NEARER: where nothing is clearly behind.
const float GAP = 3.0;
const float COVER = 6.0;
const float SAME = 0.25;
const float NEARER = 0.001;
const float DIAGONAL = 0.25; // weight of a pixel that touches at a corner
const int ALONG = 12; // px, less one
const float SNAP = 1.0 / 128.0; // px: rasterisers place corners on a grid of 1/256
// Sums of shares: up to FEW they belong to an outline, a wire, a corner or a fold; from MANY on to a tangle.
const float FEW = 1.4;
const float MANY = 2.0;
const int ROW = 512; // crossings in a row of their texture

ivec2 inside_picture(ivec2 place)
{
    return clamp(place, ivec2(0), ivec2(image_size) - 1);
}

LIGHT seen_at(ivec2 place)
{
    return texelFetch(picture, inside_picture(place), 0).OF;
}

float depth_at(ivec2 place)
{
    return texelFetch(depths, inside_picture(place), 0).r;
}

void main()
{
    ivec2 here = in_pixel.xy;
    // One point in the middle of its pixel, in NDC.
    gl_Position = vec4((vec2(here) + 0.5) / image_size * 2.0 - 1.0, 0.5, 1.0);

    LIGHT seen[9]; // row by row, the pixel itself in the middle
    float there[9];
    for (int k = 0; k < 9; ++k) {
        ivec2 beside = here + ivec2(k % 3, k / 3) - 1;
        seen[k] = seen_at(beside);
        there[k] = depth_at(beside);
    }
    LIGHT plain = seen[4], change = LIGHT(0.0);
    float own = there[4];
    // Sums of the silhouettes' shares and their sizes; of the creases' shares, the directions to their other sides, and
    // the sizes of those that are not seams.
    float shares = 0.0, sizes = 0.0, creases = 0.0, bent = 0.0;
    vec2 towards = vec2(0.0);

    // The pixel's crossings, CROSSING numbers each in two texels (contours.py): share, turn, room, depth; left, gain,
    // kind.
    for (int n = in_pixel.z; n < in_pixel.w; ++n) {
        ivec2 at = ivec2(2 * (n % ROW), n / ROW);
        vec4 first = texelFetch(crossings, at, 0), second = texelFetch(crossings, at + ivec2(1, 0), 0);
        float share = first.x, turn = first.y, room = first.z, depth = first.w;
        vec2 left = second.xy;
        float further = second.z, kind = second.w;
        // 0: a silhouette; -1: one of the two faces' inner side, which runs back; 1: a crease; 2: a seam of textures
        bool crease = kind > 0.5, seam = kind > 1.5, back_again = kind < -0.5;

        if (crease) {
            // Otherwise the pixel shows something else. Seams are those of small parts of bent bodies, near what is
            // behind them.
            if (own <= depth * (1.0 + COVER * pixel) && own >= depth * (1.0 - (seam ? GAP * pixel : SAME))) {
                creases += share;
                towards += share * left;
                bent += seam ? 0.0 : abs(share);
            }
            continue;
        }

        // The surface is on this side.
        vec2 inwards = back_again ? -left : left;
        bool on_left = room > 0.0, inside = back_again != on_left;
        float behind = depth * (1.0 - GAP * pixel), before = depth * (1.0 + SAME);
        // Of a plane that ends at the horizon the depth beside the line differs much; extrapolated, it is the line's.
        ivec2 aside = ivec2(round(1.2 * inwards)), to_front = inside ? here : here + aside;
        float front_depth = depth_at(to_front), within = depth_at(inside_picture(to_front) + aside);
        float reached = front_depth + (front_depth - within) * clamp(inside ? abs(room) : 1.0 - abs(room), 0.0, 1.0);
        bool horizon = front_depth > before && abs(reached - depth) < SAME * depth;
        if (horizon)
            before = 2.0 * front_depth;
        LIGHT fronts = LIGHT(0.0), backs = LIGHT(0.0), front = plain, back = plain;
        float in_front = 0.0, at_back = 0.0;
        for (int k = 0; k < 9; ++k) {
            float weight = k == 4 ? 0.0 : k % 2 == 1 ? 1.0 : DIAGONAL;
            bool far = there[k] < behind, near = !far && there[k] < before;
            backs += far ? weight * seen[k] : LIGHT(0.0);
            at_back += far ? (k == 4 ? 1e-9 : weight) : 0.0;
            fronts += near ? weight * seen[k] : LIGHT(0.0);
            in_front += near ? weight : 0.0;
        }
        bool known;
        // Something behind the line is visible around the pixel: the picture has a step here.
        if (at_back > 0.0) {
            if (own > (inside ? before : depth * (1.0 + COVER * pixel)))
                continue; // something else hides the line
            inside = own >= behind;
            known = inside || in_front > 0.0;
            if (inside)
                back = backs / at_back;
            else if (known)
                front = fronts / in_front;
        } else {
            // Two surfaces that meet or nearly so: to the line's left and right. The one behind, extrapolated as a
            // plane to the line, is not nearer. (A floor under a body is nearer beside it.)
            ivec2 to_back = here - aside;
            float back_depth = depth_at(to_back);
            if (abs(room) < SNAP) { // the drawn value decides
                front_depth = depth_at(here + aside);
                inside = abs(own - front_depth) < abs(own - back_depth);
                to_front = inside ? here : here + aside;
            }
            if (inside) {
                front_depth = own;
            } else {
                to_back = here;
                back_depth = own;
            }
            float beyond = depth_at(inside_picture(to_back) - aside);
            float steps_off = clamp(inside ? 1.0 - abs(room) : abs(room), 0.0, 1.0);
            float continued = back_depth + (back_depth - beyond) * steps_off;
            if (!(min(continued, back_depth) < depth * (1.0 + NEARER)))
                continue;
            known = abs(front_depth - depth) < SAME * depth || horizon;
            front = seen_at(to_front);
            back = seen_at(to_back);
        }
        // A surface narrower than a pixel may be between all centres around, and visible further along.
        if (!known) {
            vec2 onwards = vec2(left.y, -left.x) / max(abs(left.x), abs(left.y));
            for (int k = 0; k < 2 * ALONG && !known; ++k) {
                int steps = (k % 2 * 2 - 1) * (k / 2 + 2);
                ivec2 beside = ivec2(floor(vec2(here) + 0.5 + float(steps) * onwards));
                float expected = depth + float(steps) * further;
                known = abs(depth_at(beside) - expected) < SAME * expected;
                if (known)
                    front = seen_at(beside);
            }
        }
        if (!known)
            continue;
        // A centre on the line is to its left where its visible surface is.
        if (abs(room) < SNAP && on_left != (back_again != inside)) {
            on_left = !on_left;
            float least = turn - 8.0 * round(turn / 8.0), other = least;
            if (on_left != least > 0.0 && abs(least) > 2.0)
                other += on_left ? 8.0 : -8.0;
            share -= 0.125 * (other - turn);
        }
        // The crossing moves its share of the pixel from the one surface to the other.
        change += share * (front - back);
        shares += share;
        sizes += abs(share);
    }

    // A surface folded within the pixel covers parts of it twice: limit to the whole. Where it covers the centre twice
    // the sum starts from two.
    float whole = 1.0;
    if (shares < -1.0)
        whole = max(shares + 1.0, -1.0) / shares;
    else if (shares > 1.0)
        whole = 1.0 / shares;
    LIGHT result = plain + change * whole;
    // A surface rough below a pixel has too many layers to count those over the centre: use their mean.
    LIGHT around = LIGHT(0.0);
    for (int k = 0; k < 9; ++k)
        around += (k == 4 ? 0.25 : k % 2 == 1 ? 0.125 : 0.0625) * seen[k];
    result = mix(result, around, smoothstep(FEW, MANY, sizes));

    // Of a crease the centre shows one side: the other has the sum's share, with either sign.
    if (towards != vec2(0.0)) {
        float weights = 0.0, level = (bent > 0.0 ? SAME : COVER * pixel) * own;
        LIGHT others = LIGHT(0.0);
        towards = normalize(towards);
        for (int k = 0; k < 9; ++k) {
            vec2 by = vec2(k % 3, k / 3) - 1.0;
            float weight = max(dot(by, towards) / max(dot(by, by), 1.0) - 0.3, 0.0);
            weight = abs(there[k] - own) < level ? weight : 0.0;
            others += weight * seen[k];
            weights += weight;
        }
        if (weights > 0.0)
            result += min(abs(creases), 1.0) * (others / weights - plain);
    }
    result = max(result, min(LIGHT(0.0), plain));
    light = vec4(0.0);
    light.OF = result;
}
#endif

#ifdef FRAGMENT_SHADER
flat in vec4 light;
layout(location = 0) out vec4 result;

void main()
{
    result = light;
}
#endif
