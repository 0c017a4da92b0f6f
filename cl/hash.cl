// Hashes of rays: equal or close keys for rays that are likely to meet the same triangles
// (Reis et al. 2017, section 3.3.2, figures 2 and 3).
//
// HASH_PAPER   shadow rays, which start at their light: light index above the direction in spherical
//              coordinates; other rays: the cell of the origin above the direction. The paper prints no
//              numbers of bits; the numbers of bits are the best found (raystream/hash.py).
// otherwise    COARSE_BITS of each octahedral coordinate of the direction, interleaved, above the
//              cell of the origin along a Hilbert curve, above the next FINE_BITS of the direction.
//              Few direction bits first keep opposite rays apart, then neighbours in space stay
//              together. Where all rays share an origin, as a light's shadow rays do, the cell of
//              the end, END_BITS an axis, says more than the direction: also how far they reach.
//              Where such rays have no end, WIDE_BITS of the direction are all there is.
//
// Cells divide the box of the origins of the rays at hand, or that of their ends, evenly along every
// axis; the boxes are measured first. Equal keys keep the order of the slots, so that coherence on the
// screen survives.
//
// Build-time constants: CHUNKS, CELL_BITS (of a coordinate of the origin); HASH_PAPER,
// ANGLE_BITS, SHADOW_ANGLE_BITS, or COARSE_BITS, FINE_BITS, WIDE_BITS, END_BITS.

#include "hilbert.h"
#include "rays.h"

// What a key divides: grid[0] origins, grid[1] ends.
typedef struct {
    float4 low;
    float4 extent; // infinite or NaN where a ray has no end
} Box;

// Boxes per chunk of rays, of every `step`-th run of sixteen: low and high corner of the origins, of the
// ends; inf, -inf where empty.
kernel void measure_rays(const ulong n, const uint step, global const float4 *restrict org_tnear,
                         global const float4 *restrict dir_tfar, global float4 *restrict corners)
{
    float16 low[6], high[6];
    for (uint k = 0; k < 6; k++)
        low[k] = INFINITY, high[k] = -INFINITY;
    for (ulong i = chunk_begin(n), end = chunk_end(n); i < end; i += 16 * step) {
        const Rays16 r = load_rays(i, end, org_tnear, dir_tfar);
        const int16 active = r.tfar >= r.tnear;
        if (MASK16(active) == 0)
            continue;
        const float16 points[6] = {r.ox,
                                   r.oy,
                                   r.oz,
                                   FMA16(r.dx, r.tfar, r.ox),
                                   FMA16(r.dy, r.tfar, r.oy),
                                   FMA16(r.dz, r.tfar, r.oz)};
        for (uint k = 0; k < 6; k++) {
            const int16 lower = active & (points[k] < low[k]);
            const int16 higher = active & (points[k] > high[k]);
            low[k] = lower ? points[k] : low[k];
            high[k] = higher ? points[k] : high[k];
        }
    }
    for (uint k = 0; k < 6; k += 3, corners += 2) {
        global float4 *mine = corners + 4 * get_global_id(0);
        mine[0] = (float4)(lowest(low[k]), lowest(low[k + 1]), lowest(low[k + 2]), 0.0f);
        mine[1] = -(float4)(lowest(-high[k]), lowest(-high[k + 1]), lowest(-high[k + 2]), 0.0f);
    }
}

// One work-item.
kernel void make_grid(global const float4 *restrict corners, global Box *restrict grid)
{
    for (uint k = 0; k < 2; k++) {
        float4 low = INFINITY, high = -INFINITY;
        for (uint c = 0; c < CHUNKS; c++) {
            const float4 l = corners[4 * c + 2 * k], h = corners[4 * c + 2 * k + 1];
            low = l < low ? l : low;
            high = h > high ? h : high;
        }
        grid[k].low = low;
        grid[k].extent = high - low;
    }
}

// `x` rounded down, at least 0 and at most `last`; NaN, of infinite extents, is `last`.
inline uint16 whole(float16 x, uint last)
{
    const float16 most = x < (float)last ? x : (float16)last;
    return CONVERT(uint16, most > 0.0f ? most : 0.0f);
}

inline uint16 cell(float16 x, float low, float extent, uint bits)
{
    const float scale = (float)(1u << bits) / extent;
    return whole((x - low) * (extent > 0.0f && scale < INFINITY ? scale : 0.0f), (1u << bits) - 1);
}

#ifdef HASH_PAPER

INLINE uint16 hash_rays16(Rays16 r, Box origins, Box ends, uint light)
{
    const float16 azimuth = atan2(r.dy, r.dx) * (0.5f / M_PI_F) + 0.5f;
    const float16 polar = atan2(sqrt(r.dx * r.dx + r.dy * r.dy), r.dz) * (1.0f / M_PI_F);
    const uint bits = light == INVALID ? ANGLE_BITS : SHADOW_ANGLE_BITS;
    uint16 key = light;
    if (light == INVALID) {
        const float4 low = origins.low, extent = origins.extent;
        key = cell(r.ox, low.x, extent.x, CELL_BITS) << CELL_BITS
              | cell(r.oy, low.y, extent.y, CELL_BITS);
        key = key << CELL_BITS | cell(r.oz, low.z, extent.z, CELL_BITS);
    }
    const float steps = (float)(1u << bits);
    key = key << bits | whole(azimuth * steps, (1u << bits) - 1);
    return key << bits | whole(polar * steps, (1u << bits) - 1);
}

#else

// The direction on the octahedron, unfolded to the square of 2^WIDE_BITS cells (Meyer et al. 2010).
INLINE void octahedral(const Rays16 *r, uint16 *x, uint16 *y)
{
    const float16 mx = magnitude(r->dx), my = magnitude(r->dy), mz = magnitude(r->dz);
    const float16 largest = larger(mx, larger(my, mz)); // first, so that the sum stays finite
    const float16 sum = mx / largest + my / largest + mz / largest;
    const float16 u = r->dx / largest / sum, v = r->dy / largest / sum;
    const float16 folded_u = u >= 0.0f ? 1.0f - magnitude(v) : magnitude(v) - 1.0f;
    const float16 folded_v = v >= 0.0f ? 1.0f - magnitude(u) : magnitude(u) - 1.0f;
    const int16 below = r->dz < 0.0f;
    const float half_side = (float)(1 << WIDE_BITS) * 0.5f;
    *x = whole(((below ? folded_u : u) + 1.0f) * half_side, (1u << WIDE_BITS) - 1);
    *y = whole(((below ? folded_v : v) + 1.0f) * half_side, (1u << WIDE_BITS) - 1);
}

// Bits of x at the odd places, of y at the even ones.
inline uint16 spread_pairs(uint16 v)
{
    v = (v | v << 8) & 0x00ff00ffu;
    v = (v | v << 4) & 0x0f0f0f0fu;
    v = (v | v << 2) & 0x33333333u;
    return (v | v << 1) & 0x55555555u;
}

inline uint16 interleave(uint16 x, uint16 y) { return spread_pairs(x) << 1 | spread_pairs(y); }

inline uint16 place(float16 x, float16 y, float16 z, Box box, uint bits)
{
    return hilbert_place(cell(x, box.low.x, box.extent.x, bits),
                         cell(y, box.low.y, box.extent.y, bits),
                         cell(z, box.low.z, box.extent.z, bits), bits);
}

INLINE uint16 hash_rays16(Rays16 r, Box origins, Box ends, uint light)
{
    if (largest3(origins.extent) <= 0.0f && largest3(ends.extent) < INFINITY)
        return place(FMA16(r.dx, r.tfar, r.ox), FMA16(r.dy, r.tfar, r.oy),
                     FMA16(r.dz, r.tfar, r.oz), ends, END_BITS);
    uint16 x, y;
    octahedral(&r, &x, &y);
    if (largest3(origins.extent) <= 0.0f)
        return interleave(x, y);
    const uint left = WIDE_BITS - COARSE_BITS - FINE_BITS;
    const uint16 direction = interleave(x >> left, y >> left);
    return (direction >> 2 * FINE_BITS) << (3 * CELL_BITS + 2 * FINE_BITS)
           | place(r.ox, r.oy, r.oz, origins, CELL_BITS) << 2 * FINE_BITS
           | (direction & ((1u << 2 * FINE_BITS) - 1));
}

#endif

// The keys of sixteen rays, 0 for those that are not `traced`: many a stream has few that are.
INLINE uint16 keys_of(Rays16 r, int16 traced, Box origins, Box ends, uint light)
{
    if (MASK16(traced) == 0)
        return 0;
    return hash_rays16(r, origins, ends, light) & as_uint16(traced);
}

// keys[i] of ray i.
kernel void hash_all(const ulong n, global const float4 *restrict org_tnear,
                     global const float4 *restrict dir_tfar, global const Box *restrict grid,
                     const uint light, global uint *restrict keys)
{
    const Box origins = grid[0], ends = grid[1];
    for (ulong i = chunk_begin(n), end = chunk_end(n); i < end; i += 16) {
        const Rays16 r = load_rays(i, end, org_tnear, dir_tfar);
        const uint16 hashes = keys_of(r, r.tfar >= r.tnear, origins, ends, light);
        if (i + 16 <= end) {
            STORE_UNALIGNED(uint16, keys + i, hashes);
            continue;
        }
        uint lanes[16] __attribute__((aligned(64)));
        *(uint16 *)lanes = hashes;
        for (uint k = 0; i + k < end; k++)
            keys[i + k] = lanes[k];
    }
}

// keys[i], and active[i]: whether slot i holds a ray that is traced.
kernel void hash_rays(const ulong n, global const uint *restrict slots,
                      global const float4 *restrict org_tnear,
                      global const float4 *restrict dir_tfar, global const Box *restrict grid,
                      const uint light, global uint *restrict keys, global uchar *restrict active)
{
    const Box origins = grid[0], ends = grid[1];
    for (ulong i = chunk_begin(n), end = chunk_end(n); i < end; i += 16) {
        const Rays16 r = gather_rays(i, 1, end, slots, org_tnear, dir_tfar);
        const int16 traced = r.tfar >= r.tnear;
        const uint16 hashes = keys_of(r, traced, origins, ends, light);
        const uchar16 flags = CONVERT(uchar16, -traced);
        if (i + 16 <= end) {
            STORE_UNALIGNED(uint16, keys + i, hashes);
            STORE_UNALIGNED(uchar16, active + i, flags);
            continue;
        }
        uint key_lanes[16] __attribute__((aligned(64)));
        uchar flag_lanes[16] __attribute__((aligned(16)));
        *(uint16 *)key_lanes = hashes;
        *(uchar16 *)flag_lanes = flags;
        for (uint k = 0; i + k < end; k++)
            keys[i + k] = key_lanes[k], active[i + k] = flag_lanes[k];
    }
}
