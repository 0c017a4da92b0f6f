// Packing a caller's ray arrays, already on the device, into the ray layout of all tracers:
// org_tnear (origin, tnear) and dir_tfar (direction, tfar), a float4 each; and telling rays of a screen.
//
// Refused is a ray that no tracer can take: a value that is NaN, an origin or direction that is
// infinite, a zero direction, a negative tnear.
//
// Build-time constant: CHUNKS.

#include "common.h"

#define LEAST_SIDE 8  // of a screen
#define FARTHEST 4.0f // neighbours may be so much farther apart than the first two
#define ROWS_AHEAD 16  // nobody has read them yet
#define TRIPLES 0x1111u // the first of every four bits
#define ORIGINS 64u     // that tell of the others

// A caller's arrays. A stride is 1, or 0 where all rays share one value.
typedef struct {
    global const float *origins, *directions, *tnear, *tfar;
    uint tnear_stride, tfar_stride;
} Given;

inline bool is_number(float x) { return x == x; }
inline bool is_finite(float x) { return is_number(x) && x - x == 0.0f; }
inline int16 are_finite(float16 x) { return x - x == 0.0f; }

// Packs ray i; whether it can be taken.
inline bool pack_ray(const Given *g, ulong i, global float4 *org_tnear, global float4 *dir_tfar)
{
    global const float *o = g->origins + 3 * i, *d = g->directions + 3 * i;
    const float near = g->tnear[i * g->tnear_stride], far = g->tfar[i * g->tfar_stride];
    org_tnear[i] = (float4)(o[0], o[1], o[2], near);
    dir_tfar[i] = (float4)(d[0], d[1], d[2], far);
    const bool finite = is_finite(o[0]) && is_finite(o[1]) && is_finite(o[2]) && is_finite(d[0])
                        && is_finite(d[1]) && is_finite(d[2]);
    const bool direction = d[0] != 0.0f || d[1] != 0.0f || d[2] != 0.0f;
    return finite && direction && near >= 0.0f && is_number(far);
}

// Sixteen vectors x, y, z, x, y, ... in a, b, c and sixteen w as x, y, z, w, x, ... in four rows.
inline void insert_w(float16 a, float16 b, float16 c, float16 w, float16 *rows)
{
    rows[0] = (float16)(a.s012, w.s0, a.s345, w.s1, a.s678, w.s2, a.s9ab, w.s3);
    rows[1] = (float16)(a.scde, w.s4, a.sf, b.s01, w.s5, b.s234, w.s6, b.s567, w.s7);
    rows[2] = (float16)(b.s89a, w.s8, b.sbcd, w.s9, b.sef, c.s0, w.sa, c.s123, w.sb);
    rows[3] = (float16)(c.s456, w.sc, c.s789, w.sd, c.sabc, w.se, c.sdef, w.sf);
}

inline float16 load_bounds(global const float *values, ulong i, uint stride)
{
    if (stride == 0)
        return values[0];
    return LOAD_UNALIGNED(float16, values + i);
}

// Packs rays i, i + 1, ..., i + 15; whether all can be taken.
inline bool pack_rays16(const Given *g, ulong i, global float4 *org_tnear, global float4 *dir_tfar)
{
    global const float *o = g->origins + 3 * i, *d = g->directions + 3 * i;
    const float16 near = load_bounds(g->tnear, i, g->tnear_stride);
    const float16 far = load_bounds(g->tfar, i, g->tfar_stride);
    int16 good = (near >= 0.0f) & (far == far);
    float16 rows[4];
    const float16 o0 = LOAD_UNALIGNED(float16, o), o1 = LOAD_UNALIGNED(float16, o + 16),
                  o2 = LOAD_UNALIGNED(float16, o + 32);
    good &= are_finite(o0) & are_finite(o1) & are_finite(o2);
    insert_w(o0, o1, o2, near, rows);
    for (uint k = 0; k < 4; k++)
        ((global float16 *)(org_tnear + i))[k] = rows[k];
    const float16 d0 = LOAD_UNALIGNED(float16, d), d1 = LOAD_UNALIGNED(float16, d + 16),
                  d2 = LOAD_UNALIGNED(float16, d + 32);
    good &= are_finite(d0) & are_finite(d1) & are_finite(d2);
    insert_w(d0, d1, d2, far, rows);
    uint directions = TRIPLES;
    for (uint k = 0; k < 4; k++) {
        ((global float16 *)(dir_tfar + i))[k] = rows[k];
        const uint nonzero = MASK16(rows[k] != 0.0f);
        directions &= nonzero | nonzero >> 1 | nonzero >> 2;
    }
    return MASK16(good) == 0xffff && directions == TRIPLES;
}

// The smallest index of a ray of a chunk that is refused, INVALID where there is none.
inline uint pack_chunk(const Given *g, uint num_rays, global float4 *org_tnear, global float4 *dir_tfar)
{
    const ulong runs = num_rays / 16, stop = 16 * chunk_end(runs);
    uint first = INVALID;
    for (ulong i = 16 * chunk_begin(runs); i < stop; i += 16)
        if (!pack_rays16(g, i, org_tnear, dir_tfar) && first == INVALID)
            for (first = i; pack_ray(g, first, org_tnear, dir_tfar);)
                first++;
    if (get_global_id(0) == CHUNKS - 1)
        for (ulong i = 16 * runs; i < num_rays; i++)
            if (!pack_ray(g, i, org_tnear, dir_tfar))
                first = MIN(first, i);
    return first;
}

inline float square(float x) { return x * x; }

// How far ray j is from ray i.
inline float gap(const Given *g, ulong i, ulong j)
{
    float sum = 0.0f;
    for (uint k = 0; k < 3; k++)
        sum += square(g->origins[3 * j + k] - g->origins[3 * i + k])
               + square(g->directions[3 * j + k] - g->directions[3 * i + k]);
    return sum;
}

// The length of the rows where rays are those of a screen, pixel by pixel and row by row, else 0. Along a
// row each is near the one before, like the second to the first; it ends where one is not; and each
// row starts near the start of the row before.
inline uint find_rows(const Given *g, uint num_rays)
{
    if (num_rays < LEAST_SIDE * LEAST_SIDE)
        return 0;
    const float near = FARTHEST * FARTHEST * gap(g, 0, 1);
    const uint longest = num_rays / LEAST_SIDE;
    uint length = 1;
    while (length <= longest && gap(g, length - 1, length) <= near)
        length++;
    if (length < LEAST_SIDE || length > longest || num_rays % length != 0)
        return 0;
    for (ulong i = length; i < num_rays; i += length) {
        const ulong ahead = 3 * MIN(i + ROWS_AHEAD * length, num_rays - 1);
        PREFETCH(g->origins + ahead);
        PREFETCH(g->directions + ahead);
        if (!(gap(g, i - length, i) <= near))
            return 0;
    }
    return length;
}

// Whether some rays, spread over all, start where the first does.
inline bool have_one_origin(const Given *g, uint num_rays)
{
    bool one = true;
    for (uint k = 1; k <= ORIGINS; k++) {
        global const float *o = g->origins + 3 * ((ulong)(num_rays - 1) * k / ORIGINS);
        one = one && o[0] == g->origins[0] && o[1] == g->origins[1] && o[2] == g->origins[2];
    }
    return one;
}

// Work-item c < CHUNKS packs a chunk: facts[c] is the first ray that is refused, INVALID where there is none.
// One more finds rows meanwhile, facts[CHUNKS], and looks at origins, facts[CHUNKS + 1].
kernel void pack_rays(const uint num_rays, global const float *restrict origins,
                      global const float *restrict directions, global const float *restrict tnear,
                      const uint tnear_stride, global const float *restrict tfar,
                      const uint tfar_stride, global float4 *restrict org_tnear,
                      global float4 *restrict dir_tfar, global uint *restrict facts)
{
    const Given given = {origins, directions, tnear, tfar, tnear_stride, tfar_stride};
    const uint item = get_global_id(0);
    if (item < CHUNKS) {
        facts[item] = pack_chunk(&given, num_rays, org_tnear, dir_tfar);
        return;
    }
    facts[CHUNKS] = find_rows(&given, num_rays);
    facts[CHUNKS + 1] = have_one_origin(&given, num_rays);
}

// Rays from the camera through every pixel, row by row from the top: direction = forward + sx right
// + sy up, not normalised, so that t is the depth. `right` and `up` hold the half extents of the image
// plane at distance 1; `offset` is the sample's place in its pixel.
kernel void camera_rays(const uint width, const uint height, const float2 offset, const float4 eye,
                        const float4 right, const float4 up, const float4 forward,
                        global float4 *restrict org_tnear, global float4 *restrict dir_tfar)
{
    const uint i = get_global_id(0);
    if (i >= width * height)
        return;
    const float sx = 2.0f * ((float)(i % width) + offset.x) / (float)width - 1.0f;
    const float sy = 1.0f - 2.0f * ((float)(i / width) + offset.y) / (float)height;
    float4 direction = forward + sx * right + sy * up;
    direction.w = INFINITY;
    org_tnear[i] = eye;
    dir_tfar[i] = direction;
}
