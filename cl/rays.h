// Sixteen rays of a stream, one to a lane. A ray is two float4: origin with tnear, direction with tfar.

#include "common.h"

#define AHEAD 32 // slots that gathers look ahead: sorted rays lie all over memory

typedef struct {
    float16 ox, oy, oz, tnear, dx, dy, dz, tfar;
} Rays16;

INLINE Rays16 transpose_rays(const float4 *origins, const float4 *directions)
{
    Rays16 r;
    TRANSPOSE16(origins, r.ox, r.oy, r.oz, r.tnear);
    TRANSPOSE16(directions, r.dx, r.dy, r.dz, r.tfar);
    return r;
}

// The rays first, first + 1, ...; inactive (tfar = -inf) from `stop` on.
INLINE Rays16 load_rays(ulong first, ulong stop, global const float4 *org_tnear,
                        global const float4 *dir_tfar)
{
    if (first + 16 <= stop) {
        global const float4 *o = org_tnear + first, *d = dir_tfar + first;
        Rays16 r;
        TRANSPOSE16(o, r.ox, r.oy, r.oz, r.tnear);
        TRANSPOSE16(d, r.dx, r.dy, r.dz, r.tfar);
        return r;
    }
    float4 origins[16] __attribute__((aligned(64))), directions[16] __attribute__((aligned(64)));
    for (uint lane = 0; lane < 16; lane++) {
        const ulong ray = MIN(first + lane, stop - 1);
        origins[lane] = org_tnear[ray];
        directions[lane] = dir_tfar[ray];
        directions[lane].w = first + lane < stop ? directions[lane].w : -INFINITY;
    }
    return transpose_rays(origins, directions);
}

// A ray that will be read, unless it is INVALID.
inline void prefetch_ray(uint ray, global const float4 *org_tnear, global const float4 *dir_tfar)
{
    PREFETCH(org_tnear + (ray == INVALID ? 0 : ray));
    PREFETCH(dir_tfar + (ray == INVALID ? 0 : ray));
}

// The rays in slots first, first + step, ...; inactive (tfar = -inf) from slot `stop` on and where a slot
// holds no ray.
INLINE Rays16 gather_rays(ulong first, uint step, ulong stop, global const uint *slots,
                          global const float4 *org_tnear, global const float4 *dir_tfar)
{
    float4 origins[16] __attribute__((aligned(64))), directions[16] __attribute__((aligned(64)));
    for (uint lane = 0; lane < 16; lane++) {
        const ulong slot = first + lane * step;
        const uint ray = slot < stop ? slots[slot] : INVALID;
        prefetch_ray(slots[MIN(slot + AHEAD * step, stop - 1)], org_tnear, dir_tfar);
        origins[lane] = org_tnear[ray == INVALID ? 0 : ray];
        directions[lane] = dir_tfar[ray == INVALID ? 0 : ray];
        directions[lane].w = ray == INVALID ? -INFINITY : directions[lane].w;
    }
    return transpose_rays(origins, directions);
}
