#version 430 core
// Silhouettes and creases of a picture with one sample per pixel: pixels on them get the mean over their square.
//
// A pixel's centre is inside a surface or not: 1 or 0, while the mean over its square is a share in between. Their
// difference is a sum over the lines that bound the surface: each adds the area between it and the square's own
// boundary as seen from the centre, signed. So corners, ends of lines and surfaces narrower than a pixel are correct,
// for any order of the lines. An outline of triangles smaller than a pixel is a zigzag: some of its lines run back, and
// their shares cancel those of others. So all lines of a pixel use the same two surfaces, in either direction: those
// that the depth buffer shows around the pixel, before and behind the line's depth.
//
// The result is a mean of values of the picture, whose weights are areas: not negative, 1 in all. So no value arises
// that no surface has. Where several lines cross a pixel, which surfaces they divide is a guess. Samples in the pixel
// check it, and need no depth: a sample shows what those centres around show that a straight way leads to without
// crossing a line. A hidden line changes nothing, because both of its sides show one surface. Within the accuracy of
// the samples the shares decide.
//
// contours.py computes which lines cross which pixels (line_drawer.py): a vertex and a point for each crossed pixel.
//
// LIGHT: the type of a pixel's value, OF: its components in the picture.

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
const int ROW = 512; // crossings in a row of their texture
const int SAMPLES = 16; // a lattice: column k has row 5 k
const int LINES = 12; // that the samples look at
const int TANGLE = 48; // lines of a pixel that are looked at
const float BORDER = 0.4999; // px from the centre: a line that reaches it goes on

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

// Where a ray from a pixel's centre leaves its square, along the boundary, in half sides: 8 all round.
float around_at(vec2 place)
{
    // A line that ends in the pixel's centre has no direction.
    if (place == vec2(0.0))
        return 0.0;
    if (abs(place.x) >= abs(place.y))
        return place.y / place.x + (place.x > 0.0 ? 0.0 : 4.0);
    return (place.y > 0.0 ? 2.0 : 6.0) - place.x / place.y;
}

void main()
{
    ivec2 here = in_pixel.xy;
    gl_Position = vec4((vec2(here) + 0.5) / image_size * 2.0 - 1.0, 0.5, 1.0);

    LIGHT seen[9]; // row by row, the pixel itself in the middle
    float there[9];
    for (int k = 0; k < 9; ++k) {
        ivec2 beside = here + ivec2(k % 3, k / 3) - 1;
        seen[k] = seen_at(beside);
        there[k] = depth_at(beside);
    }
    LIGHT plain = seen[4];
    float own = there[4];
    // Of silhouettes beyond which the centre's surface is, and of those before it: the pixel's part that shows another
    // surface; the sizes of the shares, and the sum of the others' values weighted by them.
    vec2 parts = vec2(0.0), weights = vec2(0.0);
    LIGHT others[2] = LIGHT[2](LIGHT(0.0), LIGHT(0.0));
    // Of creases: the sum of the shares, the directions to their other sides, and the sizes of those that are no seams.
    float creases = 0.0, bent = 0.0;
    vec2 towards = vec2(0.0);
    // For the samples: lines' directions to the left and px from there to the centre; where they begin and end.
    vec3 lines[LINES];
    vec2 spans[LINES];
    int count = 0;

    // The pixel's crossings (contours.py), each in two texels: begin, end, room, depth; left, kind, gain.
    for (int n = in_pixel.z; n < min(in_pixel.w, in_pixel.z + TANGLE); ++n) {
        ivec2 at = ivec2(2 * (n % ROW), n / ROW);
        vec4 first = texelFetch(crossings, at, 0), second = texelFetch(crossings, at + ivec2(1, 0), 0);
        float room = first.z, depth = first.w, kind = second.z;
        vec2 left = second.xy, way = vec2(left.y, -left.x);
        // The area between the line and the square's boundary: the line's triangle with the centre, minus the square's
        // sector between the same rays, of which 8 half sides are an area of 1. The shorter way round, unless the
        // centre lies on the other side of the line.
        vec2 begin = first.x * way - room * left, end = first.y * way - room * left;
        float turn = around_at(end) - around_at(begin);
        turn -= 8.0 * round(turn / 8.0);
        if ((room > 0.0) != (turn > 0.0) && abs(turn) > 2.0)
            turn += room > 0.0 ? 8.0 : -8.0;
        float share = 0.5 * (begin.x * end.y - begin.y * end.x) - 0.125 * turn;
        if (count < LINES && own <= depth * (1.0 + COVER * pixel)) {
            lines[count] = vec3(left, room);
            vec2 far = vec2(max(abs(begin.x), abs(begin.y)), max(abs(end.x), abs(end.y)));
            spans[count++] = mix(first.xy, vec2(-9.0, 9.0), greaterThan(far, vec2(BORDER)));
        }
        // 0: a silhouette; -1: one of the two faces' inner side, which runs back; 1: a crease; 2: a seam of textures
        bool seam = kind > 1.5, back_again = kind < -0.5;
        if (kind > 0.5) {
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
        vec2 onwards = way / max(abs(left.x), abs(left.y));
        for (int k = 0; k < 2 * ALONG && !known; ++k) {
            int steps = (k % 2 * 2 - 1) * (k / 2 + 2);
            ivec2 beside = ivec2(floor(vec2(here) + 0.5 + float(steps) * onwards));
            float expected = depth + float(steps) * second.w;
            known = abs(depth_at(beside) - expected) < SAME * expected;
            front = known ? seen_at(beside) : front;
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
        // The crossing moves its share of the pixel from the centre's surface to the other.
        int side = inside ? 1 : 0;
        parts[side] += inside ? -share : share;
        weights[side] += abs(share);
        others[side] += abs(share) * (inside ? back : front);
    }

    // A surface folded within the pixel covers parts of it twice: limit to the whole.
    parts = clamp(parts, 0.0, 1.0);
    parts /= max(parts.x + parts.y, 1.0);
    LIGHT result = plain;
    for (int side = 0; side < 2; ++side)
        result += weights[side] > 0.0 ? parts[side] * (others[side] / weights[side] - plain) : LIGHT(0.0);

    // Of a crease the centre shows one side: the other has the sum's share, with either sign.
    if (towards != vec2(0.0)) {
        float total = 0.0, level = (bent > 0.0 ? SAME : COVER * pixel) * own;
        LIGHT beyond = LIGHT(0.0);
        towards = normalize(towards);
        for (int k = 0; k < 9; ++k) {
            vec2 by = vec2(k % 3, k / 3) - 1.0;
            float weight = max(dot(by, towards) / max(dot(by, by), 1.0) - 0.3, 0.0);
            weight = abs(there[k] - own) < level ? weight : 0.0;
            beyond += weight * seen[k];
            total += weight;
        }
        if (total > 0.0)
            result += min(abs(creases), 1.0 - parts.x - parts.y) * (beyond / total - plain);
    }
    if (count > 1) {
        LIGHT sum = LIGHT(0.0), least = plain, most = plain;
        float counted = 0.0;
        for (int k = 0; k < SAMPLES; ++k) {
            vec2 at = (vec2(k, 5 * k % SAMPLES) + 0.5) / float(SAMPLES) - 0.5;
            // The nearest four centres of the picture: its own, those across, down and at the corner. Is the way cut?
            ivec2 quarter = ivec2(sign(at));
            vec4 x = vec4(0.0, quarter.x, 0.0, quarter.x), y = vec4(0.0, 0.0, quarter.y, quarter.y);
            bvec2 outside = notEqual(here + quarter, inside_picture(here + quarter));
            bvec4 cut = bvec4(false, outside, any(outside));
            for (int n = 0; n < count; ++n) {
                vec3 line = lines[n];
                float off = dot(line.xy, at) + line.z, along = line.y * at.x - line.x * at.y;
                vec4 offs = line.x * x + line.y * y + line.z, alongs = line.y * x - line.x * y;
                vec4 meet = (alongs * off - along * offs) / (off - offs);
                for (int i = 0; i < 4; ++i)
                    cut[i] = cut[i] || offs[i] * off < 0.0 && meet[i] > spans[n].x && meet[i] < spans[n].y;
            }
            vec4 away = (x - at.x) * (x - at.x) + (y - at.y) * (y - at.y);
            vec4 near = mix(1.0 / (away * sqrt(away)), vec4(0.0), cut);
            float total = near.x + near.y + near.z + near.w;
            if (total + weights.x == 0.0)
                continue;
            LIGHT value = near.x * plain + near.y * seen[4 + quarter.x] + near.z * seen[4 + 3 * quarter.y];
            value += near.w * seen[4 + quarter.x + 3 * quarter.y];
            // What no centre shows is a surface between them: one of those in front.
            value = total > 0.0 ? value / total : others[0] / weights.x;
            sum += value;
            least = min(least, value);
            most = max(most, value);
            counted += 1.0;
        }
        LIGHT accuracy = (most - least) / float(SAMPLES);
        sum /= max(counted, 1.0);
        if (counted > 0.0)
            result = clamp(clamp(result, sum - accuracy, sum + accuracy), least, most);
    }
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
