#version 430 core
// Silhouettes and creases of a picture that has one sample a pixel, as the pixels would have them that take the mean of
// their whole squares.
//
// A pixel's centre is inside of a surface or not: 1 or 0, where the mean over its square is a share in between. Their
// difference is a sum over the lines that bound the surface: each adds the area that lies between it and the square's
// own boundary as seen from the centre, signed. So corners, ends of lines and surfaces that are narrower than a pixel
// come out right, whatever the order of the lines, and blending has only to add.
//
// An outline of triangles smaller than a pixel is a zigzag: some of its lines run back, and their shares cancel those of
// others. So all lines of a pixel have to mean the same two surfaces by "in front" and "behind", whichever way they run:
// those that the depth buffer shows around the pixel, before and behind the line's depth.
//
// STEP 0 writes zeros where lines are. STEP 1 adds up: what the silhouettes change of the picture and the sum of their
// shares; the sum of the creases' shares and the way to a crease's other side. STEP 2 puts it together (FLOOR, a vec4: the
// least that the sum may be, since what lines of different surfaces do not know of each other may take more away than
// there is).

#ifndef STEP
#define STEP 0
#endif
#ifndef FLOOR
#define FLOOR vec4(0.0)
#endif

#ifdef VERTEX_SHADER
in vec2 in_place;
uniform vec2 image_size;
#if STEP == 1
in vec3 in_start;
in vec3 in_end;
in float in_kind;
flat out vec3 start;
flat out vec3 end;
flat out float kind;
#endif

void main()
{
    gl_Position = vec4(in_place / image_size * 2.0 - 1.0, 0.5, 1.0);
#if STEP == 1
    start = in_start;
    end = in_end;
    kind = in_kind;
#endif
}
#endif

#ifdef FRAGMENT_SHADER
// By how much depths (near / Z) differ, in parts. The first two in widths of a pixel where the surface is, since a body of
// some pixels is round by some: what is farther than GAP lies behind; what is nearer than COVER hides the line, unless the
// pixel's centre is on its surface, which may come nearer by SAME. NEARER: where nothing is clearly behind.
const float GAP = 3.0;
const float COVER = 6.0;
const float SAME = 0.25;
const float NEARER = 0.001;

uniform vec2 image_size;
#if STEP > 0
uniform float pixel; // 1 / focal length, px
#endif

ivec2 inside_picture(ivec2 pixel)
{
    return clamp(pixel, ivec2(0), ivec2(image_size) - 1);
}

#if STEP == 0
layout(location = 0) out vec4 change;
layout(location = 1) out vec4 creases;
layout(location = 2) out float lines;

void main()
{
    change = vec4(0.0);
    creases = vec4(0.0);
    lines = 0.0;
}
#elif STEP == 1
layout(location = 0) out vec4 change; // the picture's first three components; the sum of shares
layout(location = 1) out vec4 creases; // the sum of shares; towards the other side, px; 0 where all are seams
layout(location = 2) out float lines; // the sum of the sizes of silhouettes' shares

flat in vec3 start; // px and depth; the surface lies to the left of the way to the end (y points down)
flat in vec3 end;
flat in float kind; // 0: a silhouette; -1: one of the two faces' inner side, which runs back; 1: a crease; 2: a seam of textures
uniform sampler2D picture;
uniform sampler2D depths;

const float HALF = 0.5;
const float DIAGONAL = 0.25; // weight of a pixel that touches at a corner
const int ALONG = 12; // px, less one
const float SNAP = 1.0 / 128.0; // px: rasterisers place corners on a grid of 1/256

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

    vec2 left = normalize(vec2(-way.y, way.x));
    float room = dot(left, -from); // of the centre, to the line: positive on its left
    ivec2 here = ivec2(gl_FragCoord.xy);
    float own = texelFetch(depths, here, 0).r;
    bool crease = kind > 0.5, seam = kind > 1.5, back_again = kind < -0.5;
    bool on_left = room > 0.0;
    vec4 front = texelFetch(picture, here, 0), back = front;

    if (crease) {
        // Something else is there. Seams are those of small parts of bent bodies, and near what is behind them.
        if (own > depth * (1.0 + COVER * pixel) || own < depth * (1.0 - (seam ? GAP * pixel : SAME)))
            discard;
    } else {
        // The surface is on this side.
        vec2 inwards = back_again ? -left : left;
        bool inside = back_again != on_left;
        float behind = depth * (1.0 - GAP * pixel), before = depth * (1.0 + SAME);
        // Of a plane that ends at the horizon the depth beside the line is another one altogether; continued, it is the
        // line's.
        ivec2 aside = ivec2(round(1.2 * inwards)), to_front = inside ? here : inside_picture(here + aside);
        float front_depth = texelFetch(depths, to_front, 0).r;
        float within = texelFetch(depths, inside_picture(to_front + aside), 0).r;
        float reached = front_depth + (front_depth - within) * clamp(inside ? abs(room) : 1.0 - abs(room), 0.0, 1.0);
        bool horizon = front_depth > before && abs(reached - depth) < SAME * depth;
        if (horizon)
            before = 2.0 * front_depth;
        vec4 fronts = vec4(0.0), backs = vec4(0.0);
        float in_front = 0.0, at_back = 0.0;
        for (int k = 0; k < 9; ++k) {
            ivec2 by = ivec2(k % 3, k / 3) - 1, beside = inside_picture(here + by);
            float there = k == 4 ? own : texelFetch(depths, beside, 0).r;
            float weight = k == 4 ? 0.0 : by.x == 0 || by.y == 0 ? 1.0 : DIAGONAL;
            // (One look for both: a processor takes every branch.)
            vec4 seen = weight * texelFetch(picture, beside, 0);
            bool far = there < behind, near = !far && there < before;
            backs += far ? seen : vec4(0.0);
            at_back += far ? (k == 4 ? 1e-9 : weight) : 0.0;
            fronts += near ? seen : vec4(0.0);
            in_front += near ? weight : 0.0;
        }
        bool known;
        if (at_back > 0.0) {
            if (own > (inside ? before : depth * (1.0 + COVER * pixel)))
                discard; // something else hides the line
            inside = own >= behind;
            known = inside || in_front > 0.0;
            if (inside)
                back = backs / at_back;
            else if (known)
                front = fronts / in_front;
        } else {
            // Two surfaces that meet or nearly so: those to the line's left and right. What lies behind it, continued as a
            // plane to the line, is not nearer. (A floor that a body stands on is nearer beside it, and is not where they
            // meet.)
            ivec2 to_back = inside_picture(here - aside);
            float back_depth = texelFetch(depths, to_back, 0).r;
            if (abs(room) < SNAP) { // what was drawn there decides
                front_depth = texelFetch(depths, inside_picture(here + aside), 0).r;
                inside = abs(own - front_depth) < abs(own - back_depth);
                to_front = inside ? here : inside_picture(here + aside);
            }
            if (inside) {
                front_depth = own;
            } else {
                to_back = here;
                back_depth = own;
            }
            float beyond = texelFetch(depths, inside_picture(to_back - aside), 0).r;
            float steps_off = clamp(inside ? 1.0 - abs(room) : abs(room), 0.0, 1.0);
            float continued = back_depth + (back_depth - beyond) * steps_off;
            if (!(min(continued, back_depth) < depth * (1.0 + NEARER)))
                discard;
            known = abs(front_depth - depth) < SAME * depth || horizon;
            front = texelFetch(picture, to_front, 0);
            back = texelFetch(picture, to_back, 0);
        }
        // Where it is narrower than a pixel the surface may be between all centres around, and seen further along.
        vec2 onwards = way / max(abs(way.x), abs(way.y));
        float further = (end.z - start.z) / max(abs(way.x), abs(way.y));
        bool from_afar = !known;
        ivec2 beside = here;
        for (int k = 0; k < 2 * ALONG && !known; ++k) {
            int steps = (k % 2 * 2 - 1) * (k / 2 + 2);
            beside = inside_picture(ivec2(floor(gl_FragCoord.xy + float(steps) * onwards)));
            float expected = depth + float(steps) * further;
            known = abs(texelFetch(depths, beside, 0).r - expected) < SAME * expected;
        }
        if (!known)
            discard;
        if (from_afar)
            front = texelFetch(picture, beside, 0);
        if (abs(room) < SNAP)
            on_left = back_again != inside;
    }

    // The area between the line and the square's boundary: the triangle that it makes with the centre, less the square's
    // sector between the same rays.
    vec2 p = from + low * way, q = from + high * way;
    float turn = around(q) - around(p);
    turn -= 8.0 * round(turn / 8.0);
    if (on_left != turn > 0.0 && abs(turn) > 2.0)
        turn += on_left ? 8.0 : -8.0;
    float share = 0.5 * (p.x * q.y - p.y * q.x) - 0.125 * turn;
    change = crease ? vec4(0.0) : vec4(share * (front - back).rgb, share);
    lines = crease ? 0.0 : abs(share);
    creases = crease ? vec4(share, share * left, seam ? 0.0 : abs(share)) : vec4(0.0);
}
#else
layout(location = 0) out vec4 result;

uniform sampler2D picture;
uniform sampler2D depths;
uniform sampler2D changes;
uniform sampler2D creases;
uniform sampler2D lines;

// Of sums of shares: up to FEW they are those of an outline, a wire, a corner or a fold; from MANY on a tangle.
const float FEW = 1.4;
const float MANY = 2.0;

void main()
{
    ivec2 here = ivec2(gl_FragCoord.xy);
    vec4 plain = texelFetch(picture, here, 0), change = texelFetch(changes, here, 0);
    // A surface that is folded within the pixel covers parts of it twice: more than the whole is the whole. Where it
    // covers the centre twice the sum starts from two.
    float sum = change.a, whole = 1.0;
    if (sum < -1.0)
        whole = max(sum + 1.0, -1.0) / sum;
    else if (sum > 1.0)
        whole = 1.0 / sum;
    result = plain + vec4(change.rgb * whole, 0.0);
    // What is rough by less than a pixel has too many layers there to know how many hide the centre: a mean of what is seen
    // around.
    float tangled = smoothstep(FEW, MANY, texelFetch(lines, here, 0).r);
    if (tangled > 0.0) {
        vec4 around = vec4(0.0);
        for (int k = 0; k < 9; ++k) {
            ivec2 by = ivec2(k % 3, k / 3) - 1;
            around += (2.0 - abs(by.x)) * (2.0 - abs(by.y)) / 16.0 * texelFetch(picture, inside_picture(here + by), 0);
        }
        result = mix(result, around, tangled);
    }

    // Of a crease the centre shows the one side: the other has the sum's share, whatever its sign.
    vec4 crease = texelFetch(creases, here, 0);
    if (crease.yz != vec2(0.0)) {
        float own = texelFetch(depths, here, 0).r, weights = 0.0;
        vec4 others = vec4(0.0);
        vec2 towards = normalize(crease.yz);
        float level = (crease.a > 0.0 ? SAME : COVER * pixel) * own;
        for (int k = 0; k < 9; ++k) {
            ivec2 by = ivec2(k % 3, k / 3) - 1, beside = inside_picture(here + by);
            float weight = dot(vec2(by), towards) / float(max(dot(vec2(by), vec2(by)), 1.0));
            weight = max(weight - 0.3, 0.0);
            if (weight > 0.0 && abs(texelFetch(depths, beside, 0).r - own) < level) {
                others += weight * texelFetch(picture, beside, 0);
                weights += weight;
            }
        }
        if (weights > 0.0)
            result += min(abs(crease.x), 1.0) * (others / weights - plain);
    }
    result = max(result, min(FLOOR, plain));
}
#endif
#endif
