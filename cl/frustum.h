// Frusta around ray packets: section 4 of Overbeck, Ramamoorthi and Mark (2008).
//
// Four corner rays and the four planes between them, in the lanes of float4. A box or a triangle is culled by
// planes (equation 1), all vertices outside of one of them, or by corner rays: all miss the triangle outside of
// one edge, or the box by the same pair of slabs, or have left the same slab before they start.
// baselines/frustum.py is the same in numpy; it says why four corner rays suffice and what differs from the paper.
//
// Rounding, u = 2^-24. Let `extent` bound the coordinates of scene, origins and frustum. All rays advance along
// the dominant axis by at least MIN_ADVANCE of their length, so slopes are at most 16, and what is computed of
// a ray between the planes errs by at most 120 u extent; a hit of the triangle test lies up to 40 u extent beside
// its triangle (packet.h). PAD is 256 u: near and far rectangle, boxes, and the planes once more, are wider by
// PAD extent, so that nothing is culled that a ray of the packet would hit.

#include "packet.h"

#define PAD 0x1p-16f
#define SLACK 0x1p-20f      // of products: 16 u
#define FAR 0x1p-10f        // the far plane is at least so many extents beyond the near one
#define MIN_ADVANCE 0x1p-4f
#define GROW 0x1p-10f       // corner rays are moved outwards by this part of their distance to the middle
#define SMALLEST_SIZE 0x1p-30f
#define LARGEST_SIZE 0x1p60f // products of four coordinates stay finite

typedef struct {
    bool valid;
    float4 normal[3], offset;  // a point is outside of a plane where normal . x > offset
    float4 org[3], dir[3];     // corner rays, around the frustum
    float4 length;             // sum of the components of |dir|
    float steady[3];           // 1 where all corner rays rise along an axis, -1 where all fall, else 0
    float pad;
} Frustum;

inline float4 smaller4(float4 a, float4 b) { return a < b ? a : b; }
inline float4 larger4(float4 a, float4 b) { return a > b ? a : b; }

// The largest coordinate of a box.
inline float box_size(float4 low, float4 high)
{
    const float4 m = larger4(size_of4(low), size_of4(high));
    return MAX(MAX(m.x, m.y), m.z);
}

inline float lane_of(const VF *v, uint lane) { return ((const float *)v)[lane]; }

inline VI live_lanes(const SimdRay *r) { return r->frame.tfar >= 0.0f; }

// The axes u, v and k, the dominant one; k counts along the rays: with `sign`.
typedef struct {
    uint u, v, k;
    float sign;
} Axes;

inline Axes dominant_axes(const float *direction)
{
    Axes a = {1, 2, 0, 1.0f};
    if (size_of(direction[1]) > size_of(direction[0]))
        a.k = 1, a.u = 2, a.v = 0;
    if (size_of(direction[2]) > size_of(direction[a.k]))
        a.k = 2, a.u = 0, a.v = 1;
    a.sign = direction[a.k] < 0.0f ? -1.0f : 1.0f;
    return a;
}

// Section 4.3: where the rays pierce the near and the far plane, the planes u min, v min, u max, v max in the
// lanes. False where a ray does not advance.
inline bool pierce_planes(const SimdRay *rays, uint count, Axes a, float near, float far,
                          float4 *at_near, float4 *at_far)
{
    VF low[4], high[4], advance = INFINITY;
    for (uint k = 0; k < 4; k++)
        low[k] = INFINITY, high[k] = -INFINITY;
    for (uint i = 0; i < count; i++) {
        const SimdRay *r = rays + i;
        const VI live = live_lanes(r);
        const VF forward = CHOOSE(live, r->unit[a.k] * a.sign, 1.0f), o = r->org[a.k] * a.sign;
        advance = forward < advance ? forward : advance;
        for (uint end = 0; end < 2; end++) {
            const VF way = (end ? far : near) - o;
            for (uint axis = 0; axis < 2; axis++) {
                const uint uv = axis ? a.v : a.u, k = 2 * end + axis;
                const VF place = r->org[uv] + r->unit[uv] / forward * way;
                low[k] = (live & (place < low[k])) ? place : low[k];
                high[k] = (live & (place > high[k])) ? place : high[k];
            }
        }
    }
    *at_near = (float4)(least_lane(low[0]), least_lane(low[1]), most_lane(high[0]), most_lane(high[1]));
    *at_far = (float4)(least_lane(low[2]), least_lane(low[3]), most_lane(high[2]), most_lane(high[3]));
    return least_lane(advance) >= MIN_ADVANCE;
}

// Sections 4.2 and 4.3, of planes and rectangles that hold all rays.
inline void set_near_far(Frustum *f, Axes a, float near, float far, float4 at_near, float4 at_far)
{
    const float4 outward = (float4)(-1.0f, -1.0f, 1.0f, 1.0f);
    at_near += outward * f->pad, at_far += outward * f->pad;
    const float4 slope = (at_far - at_near) / (far - near);
    f->normal[a.u] = (float4)(-1.0f, 0.0f, 1.0f, 0.0f);
    f->normal[a.v] = (float4)(0.0f, -1.0f, 0.0f, 1.0f);
    f->normal[a.k] = -outward * slope * a.sign;
    f->offset = outward * (at_near - slope * near) + f->pad * (1.0f + size_of4(slope));
    f->org[a.u] = at_near.xzzx, f->org[a.v] = at_near.yyww, f->org[a.k] = near * a.sign;
    f->dir[a.u] = at_far.xzzx - at_near.xzzx, f->dir[a.v] = at_far.yyww - at_near.yyww;
    f->dir[a.k] = (far - near) * a.sign;
}

// Section 4.1: the tile's corner rays, moved outwards a little, where all rays lie inside of them; else
// false, and the frustum stays.
inline bool set_corner_rays(Frustum *f, const SimdRay *rays, uint count, uint side, Axes a)
{
    const uint place[4] = {0, side - 1, side * side - 1, side * (side - 1)};
    const uint lane[4] = {0, SIDE - 1, WIDTH - 1, WIDTH - SIDE};
    float cu[4], cv[4];
    for (uint i = 0; i < 4; i++) {
        const SimdRay *r = rays + place[i];
        if (!(r->live >> lane[i] & 1))
            return false;
        const float forward = lane_of(r->unit + a.k, lane[i]) * a.sign;
        cu[i] = lane_of(r->unit + a.u, lane[i]) / forward;
        cv[i] = lane_of(r->unit + a.v, lane[i]) / forward;
    }
    float4 u = (float4)(cu[0], cu[1], cu[2], cu[3]), v = (float4)(cv[0], cv[1], cv[2], cv[3]);
    u += GROW * (u - 0.25f * ((u.x + u.y) + (u.z + u.w)));
    v += GROW * (v - 0.25f * ((v.x + v.y) + (v.z + v.w)));
    const float4 du = u.yzwx - u, dv = v.yzwx - v;
    const float4 turn = du * dv.yzwx - dv * du.yzwx;
    const uint left = MASK4(turn > 0.0f), right = MASK4(turn < 0.0f);
    if (left != 15 && right != 15)
        return false;
    const float4 nu = left ? dv : -dv, nv = left ? -du : du;
    const float4 width = size_of4(nu) + size_of4(nv);
    const float4 margin = -SLACK * width * (1.0f + (size_of4(u) + size_of4(v)));
    const float nus[4] = {nu.x, nu.y, nu.z, nu.w}, nvs[4] = {nv.x, nv.y, nv.z, nv.w};
    const float us[4] = {u.x, u.y, u.z, u.w}, vs[4] = {v.x, v.y, v.z, v.w};
    const float margins[4] = {margin.x, margin.y, margin.z, margin.w};
    VI outside = 0;
    for (uint i = 0; i < count; i++) {
        const SimdRay *r = rays + i;
        const VF forward = r->unit[a.k] * a.sign;
        const VF su = r->unit[a.u] / forward, sv = r->unit[a.v] / forward;
        for (uint k = 0; k < 4; k++)
            outside |= live_lanes(r)
                       & !(nus[k] * (su - us[k]) + nvs[k] * (sv - vs[k]) < margins[k]);
    }
    if (MASK_V(outside))
        return false;
    const float origin[3]
        = {lane_of(rays->org, 0), lane_of(rays->org + 1, 0), lane_of(rays->org + 2, 0)};
    const float4 nk = -(nu * u + nv * v);
    f->normal[a.u] = nu, f->normal[a.v] = nv, f->normal[a.k] = nk * a.sign;
    f->offset = nu * origin[a.u] + nv * origin[a.v] + nk * (origin[a.k] * a.sign)
                + f->pad * (width + size_of4(nk));
    f->dir[a.u] = u, f->dir[a.v] = v, f->dir[a.k] = a.sign;
    for (uint axis = 0; axis < 3; axis++)
        f->org[axis] = origin[axis];
    return true;
}

// `direction` is the sum of the unit directions; `side` of the tile in SIMD rays, 0 where its corners do not
// all hold rays.
inline void bound_packet(Frustum *f, const SimdRay *rays, uint count, const float *direction,
                         uint side, float4 scene_low, float4 scene_high)
{
    const float lows[3] = {scene_low.x, scene_low.y, scene_low.z};
    const float highs[3] = {scene_high.x, scene_high.y, scene_high.z};
    const Axes a = dominant_axes(direction);
    float size = box_size(scene_low, scene_high), near = 0.0f;
    bool shared = true;
    for (uint axis = 0; axis < 3; axis++) {
        VF low = INFINITY, high = -INFINITY;
        for (uint i = 0; i < count; i++) {
            const VF o = rays[i].org[axis];
            low = (live_lanes(rays + i) & (o < low)) ? o : low;
            high = (live_lanes(rays + i) & (o > high)) ? o : high;
        }
        const float first = least_lane(low), last = most_lane(high);
        size = MAX(size, MAX(size_of(first), size_of(last)));
        shared &= first == last;
        if (axis == a.k)
            near = a.sign > 0.0f ? first : -last;
    }
    f->valid = false;
    if (!(size >= SMALLEST_SIZE && size <= LARGEST_SIZE))
        return;
    const float scene_far = a.sign > 0.0f ? highs[a.k] : -lows[a.k];
    const float far = MAX(scene_far, near + FAR * size);
    float4 at_near, at_far;
    if (!pierce_planes(rays, count, a, near, far, &at_near, &at_far))
        return;
    f->valid = true;
    f->pad = PAD * size;
    if (!(shared && side && set_corner_rays(f, rays, count, side, a))) {
        const float4 ends = larger4(size_of4(at_near), size_of4(at_far));
        f->pad = PAD * MAX(MAX(size, MAX(ends.x, ends.y)), MAX(ends.z, ends.w));
        set_near_far(f, a, near, far, at_near, at_far);
    }
    f->length = size_of4(f->dir[0]) + size_of4(f->dir[1]) + size_of4(f->dir[2]);
    for (uint axis = 0; axis < 3; axis++)
        f->steady[axis] = MASK4(f->dir[axis] > 0.0f) == 15
                              ? 1.0f
                              : (MASK4(f->dir[axis] < 0.0f) == 15 ? -1.0f : 0.0f);
}

// A ray that rises along axis a leaves the slab of a at high[a], one that falls at low[a]. It misses the box if it
// leaves one slab before it enters another, or before it starts.
inline bool rays_cull_box(const Frustum *f, float4 low, float4 high)
{
    low -= f->pad, high += f->pad;
    const float lows[3] = {low.x, low.y, low.z}, highs[3] = {high.x, high.y, high.z};
    float4 enter[3], leave[3];
    for (uint a = 0; a < 3; a++) {
        const bool rising = f->steady[a] > 0.0f;
        leave[a] = (rising ? highs[a] : lows[a]) - f->org[a];
        enter[a] = (rising ? lows[a] : highs[a]) - f->org[a];
        if (f->steady[a] != 0.0f && MASK4(f->steady[a] * leave[a] < 0.0f) == 15)
            return true;
    }
    for (uint a = 0; a < 3; a++)
        for (uint b = 0; b < 3; b++) {
            if (a == b || f->steady[a] * f->steady[b] == 0.0f)
                continue;
            // leave_a / d_a < enter_b / d_b, times d_a d_b
            const float4 left = leave[a] * f->dir[b], right = enter[b] * f->dir[a];
            const float4 before = f->steady[a] * f->steady[b] * (right - left);
            if (MASK4(before > SLACK * (size_of4(left) + size_of4(right))) == 15)
                return true;
        }
    return false;
}

inline bool frustum_culls_box(const Frustum *f, float4 low, float4 high)
{
    // The box's vertex that lies least outside has the smallest product along each axis.
    const float4 x = smaller4(f->normal[0] * low.x, f->normal[0] * high.x);
    const float4 y = smaller4(f->normal[1] * low.y, f->normal[1] * high.y);
    const float4 z = smaller4(f->normal[2] * low.z, f->normal[2] * high.z);
    return MASK4(x + y + z > f->offset) || rays_cull_box(f, low, high);
}

inline float sum_of_sizes(float4 v) { return size_of(v.x) + size_of(v.y) + size_of(v.z); }

inline bool rays_cull_triangle(const Frustum *f, const float4 *v)
{
    const float4 e[3] = {v[1] - v[0], v[2] - v[1], v[0] - v[2]};
    const float4 n = cross3(e[0], e[1]);
    const float4 facing = f->dir[0] * n.x + f->dir[1] * n.y + f->dir[2] * n.z;
    const float4 slack = SLACK * (sum_of_sizes(e[0]) * sum_of_sizes(e[1])) * f->length;
    const bool front = MASK4(facing > slack) == 15, back = MASK4(facing < -slack) == 15;
    if (!front && !back)
        return false;
    for (uint k = 0; k < 3; k++) {
        const float4 x = v[k].x - f->org[0], y = v[k].y - f->org[1], z = v[k].z - f->org[2];
        const float4 side = f->dir[0] * (y * e[k].z - z * e[k].y)
                            + f->dir[1] * (z * e[k].x - x * e[k].z)
                            + f->dir[2] * (x * e[k].y - y * e[k].x);
        const float4 margin = f->pad * sum_of_sizes(e[k]) * f->length;
        if (MASK4((front ? side : -side) < -margin) == 15)
            return true;
    }
    return false;
}

inline bool frustum_culls_triangle(const Frustum *f, global const float4 *corners)
{
    const float4 v[3] = {corners[0], corners[1], corners[2]};
    float4 least = INFINITY;
    for (uint k = 0; k < 3; k++) {
        const float4 height = f->normal[0] * v[k].x + f->normal[1] * v[k].y + f->normal[2] * v[k].z;
        least = smaller4(height, least);
    }
    return MASK4(least > f->offset) || rays_cull_triangle(f, v);
}
