// Vertices that follow joints, and morph targets: q = sum w_i J_i (p + sum m_k d_k).
// rows: three of each J, then the weights m, four a row;  rate: dJ/dt, dm/dt;  change: J' - J, m' - m.
// SKIN_WEIGHTS: joints per vertex, 1 to 8.   SKIN_MORPHS: targets;   SKIN_MORPH_ROW: first row of their weights.

in vec4 in_joints_0, in_weights_0;
#if SKIN_WEIGHTS > 4
in vec4 in_joints_1, in_weights_1;
#endif

// The columns are the rows of sum w_i J_i from row ``first`` on: vec4(p, 1.0) * skin_blend(...) is the transformed p.
mat3x4 skin_blend(int first)
{
    mat3x4 sum = mat3x4(0.0);
    for (int i = 0; i < SKIN_WEIGHTS; ++i)
    {
#if SKIN_WEIGHTS > 4
        float joint = i < 4 ? in_joints_0[i] : in_joints_1[i - 4];
        float weight = i < 4 ? in_weights_0[i] : in_weights_1[i - 4];
#else
        float joint = in_joints_0[i], weight = in_weights_0[i];
#endif
        int row = first + 3 * int(joint + 0.5);
        sum[0] += weight * shape[row];
        sum[1] += weight * shape[row + 1];
        sum[2] += weight * shape[row + 2];
    }
    return sum;
}

#ifdef SKIN_MORPHS
uniform sampler2D skin_morphs; // of target k and vertex v: texel 2 (k V + v) its position, the next its normal

// sum m_k d_k of positions (what = 0) or normals (1), with the weights of a set of rows.
vec3 skin_morphed(int set, int what)
{
    ivec2 size = textureSize(skin_morphs, 0);
    vec3 sum = vec3(0.0);
    for (int k = 0; k < SKIN_MORPHS; ++k)
    {
        int texel = 2 * (k * SKIN_VERTICES + gl_VertexID) + what;
        sum += shape[set + SKIN_MORPH_ROW + k / 4][k % 4]
             * texelFetch(skin_morphs, ivec2(texel % size.x, texel / size.x), 0).xyz;
    }
    return sum;
}
#else
vec3 skin_morphed(int set, int what)
{
    return vec3(0.0);
}
#endif

vec3 deformed(vec3 p)
{
    return vec4(p + skin_morphed(0, 0), 1.0) * skin_blend(0);
}

vec3 deformed_rate(vec3 p)
{
    // The product rule: joints move the shape, and morph targets change the points that the joints move.
    vec3 q = vec4(p + skin_morphed(0, 0), 1.0) * skin_blend(SHAPE_RATE);
#ifdef SKIN_MORPHS
    q += vec4(skin_morphed(SHAPE_RATE, 0), 0.0) * skin_blend(0);
#endif
    return q;
}

vec3 deformed_change(vec3 p, int other)
{
    vec3 change = skin_morphed(other, 0);
    vec3 q = vec4(p + skin_morphed(0, 0) + change, 1.0) * skin_blend(other);
#ifdef SKIN_MORPHS
    q += vec4(change, 0.0) * skin_blend(0);
#endif
    return q;
}

// By the cofactors of the blend: valid for non-uniform scales, too.
vec3 deformed_normal(vec3 p, vec3 n)
{
    mat3x4 rows = skin_blend(0);
    vec3 a = rows[0].xyz, b = rows[1].xyz, c = rows[2].xyz, m = n + skin_morphed(0, 1);
    return vec3(dot(cross(b, c), m), dot(cross(c, a), m), dot(cross(a, b), m));
}

vec3 deformed_normal_rate(vec3 p, vec3 n)
{
    mat3x4 rows = skin_blend(0), rates = skin_blend(SHAPE_RATE);
    vec3 a = rows[0].xyz, b = rows[1].xyz, c = rows[2].xyz, m = n + skin_morphed(0, 1);
    vec3 da = rates[0].xyz, db = rates[1].xyz, dc = rates[2].xyz, dm = skin_morphed(SHAPE_RATE, 1);
    return vec3(dot(cross(db, c) + cross(b, dc), m) + dot(cross(b, c), dm),
                dot(cross(dc, a) + cross(c, da), m) + dot(cross(c, a), dm),
                dot(cross(da, b) + cross(a, db), m) + dot(cross(a, b), dm));
}
