// Large ray packets in a bounding volume hierarchy: Masked, Ranged and Partition traversal.
//
// Overbeck, Ramamoorthi and Mark, "Large Ray Packets for Real-time Whitted Ray Tracing" (2008), section 3,
// figure 2 and the appendix, with the frusta of section 4 (frustum.h). baselines/packet.py is the same in
// numpy, counts equal these, and its head says where the paper errs or leaves it open.
//
// A packet is SIDE x SIDE pixels times packet_side x packet_side: packet_side squared SIMD rays, row by row;
// without a screen as many in the order of the rays. SIMD rays without a live lane are left out. One work-item
// takes one packet after another; its stack and its rays are private.
//
// Build-time constants: WIDTH (4 or 16), DEPTH (levels of the tree at most), NUM_COUNTERS, MASKED, RANGED,
// PARTITION.

#include "frustum.h"

typedef struct {
    uint cell, state, depth;
} StackNode;

// What is counted at each depth, in the order of raystream/packet.py.
enum {
    VISITS,
    BOX_TESTS,
    BOX_HITS,
    TRIANGLE_TESTS,
    FRUSTUM_BOX_TESTS,
    FRUSTUM_BOX_CULLS,
    FRUSTUM_TRIANGLE_TESTS,
    FRUSTUM_TRIANGLE_CULLS,
    LEAVES,
    ACTIVE,
    ALIVE
};

typedef struct {
    SimdRay rays[MAX_SIMD];
    uint count;
    float direction[3]; // sum of unit directions
    Frustum frustum;
    uint least_active; // the frustum is asked where so many SIMD rays are active
    uchar indices[MAX_SIMD]; // Partition: the places of SIMD rays, the alive ones in front
    uchar active[MAX_SIMD];  // at a leaf
    uint num_active;
} Packet;

typedef struct {
    uint num_rays;
    uint width, height; // of the screen, 0 where there is none
    uint packet_side;   // SIMD rays along a side
    global const float4 *org_tnear, *dir_tfar;
} Stream;

// The ray in a lane of the SIMD ray at a place of a packet; INVALID where there is none.
inline uint ray_at(const Stream *s, uint packet, uint place, uint lane)
{
    if (s->width == 0) {
        const ulong ray = ((ulong)packet * s->packet_side * s->packet_side + place) * WIDTH + lane;
        return ray < s->num_rays ? (uint)ray : INVALID;
    }
    const uint size = s->packet_side * SIDE, tiles = (s->width + size - 1) / size;
    const uint x = packet % tiles * size + place % s->packet_side * SIDE + lane % SIDE;
    const uint y = packet / tiles * size + place / s->packet_side * SIDE + lane / SIDE;
    return x < s->width && y < s->height ? y * s->width + x : INVALID;
}

// Loads the SIMD ray at a place of a packet.
inline void load_simd_ray(const Stream *s, uint packet, uint place, float size, SimdRay *r)
{
    float lanes[8][WIDTH] __attribute__((aligned(64)));
    uint rays[WIDTH] __attribute__((aligned(64)));
    for (uint lane = 0; lane < WIDTH; lane++) {
        const uint ray = ray_at(s, packet, place, lane);
        const float4 o = s->org_tnear[ray == INVALID ? 0 : ray];
        const float4 d = s->dir_tfar[ray == INVALID ? 0 : ray];
        const float fields[8] = {o.x, o.y, o.z, o.w, d.x, d.y, d.z, d.w};
        for (uint k = 0; k < 8; k++)
            lanes[k][lane] = fields[k];
        rays[lane] = ray;
    }
    const VF *v = (const VF *)lanes;
    r->ray = *(VU *)rays;
    const VI live = (r->ray != INVALID) & (v[7] >= v[3])
                    & ((v[4] != 0.0f) | (v[5] != 0.0f) | (v[6] != 0.0f));
    set_up(r, v, v + 4, v[3], v[7], live, size);
}

inline void load_packet(Packet *p, const Stream *s, uint packet, float size)
{
    p->count = 0;
    VF total[3] = {0.0f, 0.0f, 0.0f};
    for (uint place = 0; place < s->packet_side * s->packet_side; place++) {
        SimdRay *r = p->rays + p->count;
        load_simd_ray(s, packet, place, size, r);
        if (r->live == 0)
            continue;
        const VI live = r->leave > -INFINITY;
        for (uint axis = 0; axis < 3; axis++)
            total[axis] += CHOOSE(live, r->unit[axis], 0.0f);
        p->indices[p->count] = p->count;
        p->count++;
    }
    for (uint axis = 0; axis < 3; axis++)
        p->direction[axis] = sum_lanes(total[axis]);
}

#define COUNT(what, amount) counters[depth][what] += (amount)

// Whether a packet with so many active rays may overlap a box.
inline bool frustum_meets(const Packet *p, float4 low, float4 high, uint active,
                          ulong (*counters)[NUM_COUNTERS], uint depth)
{
    if (!p->frustum.valid || active < p->least_active)
        return true;
    COUNT(FRUSTUM_BOX_TESTS, 1);
    const bool culled = frustum_culls_box(&p->frustum, low, high);
    COUNT(FRUSTUM_BOX_CULLS, culled);
    return !culled;
}

// Masked, figure 2, lines 7 to 13: an inner cell is tested up to the first hit, a leaf by all.
inline bool enter_masked(Packet *p, const Node *cell, ulong (*counters)[NUM_COUNTERS], uint depth)
{
    if (!frustum_meets(p, cell->low, cell->high, p->count, counters, depth))
        return false;
    p->num_active = 0;
    for (uint i = 0; i < p->count; i++) {
        COUNT(BOX_TESTS, 1);
        if (meet(p->rays + i, cell->low, cell->high)) {
            COUNT(BOX_HITS, 1);
            p->active[p->num_active++] = i;
            if (!IS_LEAF(*cell))
                return true;
        }
    }
    return p->num_active > 0;
}

// Ranged, appendix A.1: getFirstHit.
inline uint first_hit(const Packet *p, const Node *cell, uint ia, ulong (*counters)[NUM_COUNTERS],
                      uint depth)
{
    uint i = ia;
    COUNT(BOX_TESTS, 1);
    if (!meet(p->rays + ia, cell->low, cell->high)) {
        if (!frustum_meets(p, cell->low, cell->high, p->count - ia, counters, depth))
            return p->count;
        for (i = ia + 1; i < p->count; i++) {
            COUNT(BOX_TESTS, 1);
            if (meet(p->rays + i, cell->low, cell->high))
                break;
        }
    }
    COUNT(BOX_HITS, i < p->count);
    return i;
}

// getLastHit, and the rays from ia up to there.
inline void activate_range(Packet *p, const Node *cell, uint ia, ulong (*counters)[NUM_COUNTERS],
                           uint depth)
{
    uint last = p->count - 1;
    for (; last > ia; last--) {
        COUNT(BOX_TESTS, 1);
        if (meet(p->rays + last, cell->low, cell->high)) {
            COUNT(BOX_HITS, 1);
            break;
        }
    }
    p->num_active = 0;
    for (uint i = ia; i <= last; i++)
        p->active[p->num_active++] = i;
}

// Partition, section 3.3: partRays.
inline uint partition_rays(Packet *p, const Node *cell, uint ia, ulong (*counters)[NUM_COUNTERS],
                           uint depth)
{
    if (!frustum_meets(p, cell->low, cell->high, ia, counters, depth))
        return 0;
    uint ie = 0;
    for (uint i = 0; i < ia; i++) {
        const uchar place = p->indices[i];
        if (meet(p->rays + place, cell->low, cell->high)) {
            p->indices[i] = p->indices[ie];
            p->indices[ie++] = place;
        }
    }
    COUNT(BOX_TESTS, ia);
    COUNT(BOX_HITS, ie);
    return ie;
}

// Whether all rays of a packet are blocked.
inline bool all_blocked(const Packet *p)
{
    for (uint i = 0; i < p->count; i++)
        if (MASK_V(p->rays[i].leave >= 0.0f))
            return false;
    return true;
}

// Tests the active SIMD rays against the triangles of a leaf that the frustum does not cull.
inline void visit_leaf(Packet *p, const Node *cell, const uchar *active, uint num_active,
                       global const float4 *triangles, bool any_hit,
                       ulong (*counters)[NUM_COUNTERS], uint depth)
{
    uint slots[LEAF_SIZE], count = 0;
    for (uint k = LEAF_FIRST(*cell); k < LEAF_FIRST(*cell) + LEAF_COUNT(*cell); k++) {
        if (p->frustum.valid && num_active >= p->least_active) {
            COUNT(FRUSTUM_TRIANGLE_TESTS, 1);
            if (frustum_culls_triangle(&p->frustum, triangles + TRIANGLE_FLOAT4S * (ulong)k)) {
                COUNT(FRUSTUM_TRIANGLE_CULLS, 1);
                continue;
            }
        }
        slots[count++] = k;
    }
    COUNT(LEAVES, 1);
    COUNT(ACTIVE, num_active);
    COUNT(TRIANGLE_TESTS, num_active * count);
    for (uint i = 0; i < num_active; i++) {
        SimdRay *r = p->rays + active[i];
        COUNT(ALIVE, meet(r, cell->low, cell->high) != 0);
        intersect_triangles(r, slots, count, triangles);
        const VI hit = r->triangle != INVALID;
        // The next number: distances may be so small that they round to 0.
        const VF closest = any_hit ? (VF)-INFINITY : AS_VF(AS_VI(r->t) + 1) * r->largest;
        r->leave = hit ? closest : r->leave;
    }
}

// Takes one packet through the tree.
inline void traverse(Packet *p, uint traversal, global const Node *nodes,
                     global const float4 *triangles, bool any_hit, ulong (*counters)[NUM_COUNTERS])
{
    StackNode stack[DEPTH];
    uint top = 0, cell = 0, depth = 0;
    uint state = traversal == PARTITION ? p->count : 0; // the paper's ia
    while (true) {
        const Node node = nodes[cell];
        bool reached;
        COUNT(VISITS, 1);
        if (traversal == MASKED) {
            reached = enter_masked(p, &node, counters, depth);
        } else if (traversal == RANGED) {
            state = first_hit(p, &node, state, counters, depth);
            reached = state < p->count;
        } else {
            state = partition_rays(p, &node, state, counters, depth);
            reached = state > 0;
        }
        if (reached && !IS_LEAF(node)) {
            // The near child by the sign of the packet's direction along the axis of the split.
            const uint backward = p->direction[SPLIT_AXIS(node)] < 0.0f;
            const StackNode far = {LEFT_CHILD(node) + 1 - backward, state, depth + 1};
            stack[top++] = far;
            cell = LEFT_CHILD(node) + backward;
            depth++;
            continue;
        }
        if (reached) {
            if (traversal == RANGED)
                activate_range(p, &node, state, counters, depth);
            const bool partition = traversal == PARTITION;
            visit_leaf(p, &node, partition ? p->indices : p->active,
                       partition ? state : p->num_active, triangles, any_hit, counters, depth);
            if (any_hit && all_blocked(p))
                return;
        }
        if (top == 0)
            return;
        top--;
        cell = stack[top].cell, state = stack[top].state, depth = stack[top].depth;
    }
}

// Work-item g takes the packets g, g + global size, ...; totals[g] are its rays, SIMD rays, packets and
// rays that hit, counts[g] what it counted by depth.
#define DEFINE_PACKET_KERNEL(NAME, RESULT, NONE, ANY_HIT, FOUND)                                   \
    kernel void NAME(const uint num_packets, const uint num_rays, const uint width,                \
                     const uint height, const uint packet_side, const uint traversal,              \
                     const uint least_active, const uint num_levels, global const Node *restrict nodes, \
                     global const float4 *restrict triangles,                                      \
                     global const float4 *restrict org_tnear,                                      \
                     global const float4 *restrict dir_tfar, global RESULT *restrict result,       \
                     global ulong *restrict totals, global ulong *restrict counts)                 \
    {                                                                                              \
        const Stream stream = {num_rays, width, height, packet_side, org_tnear, dir_tfar};         \
        const Node root = nodes[0];                                                                \
        const float size = box_size(root.low, root.high);                                          \
        ulong counters[DEPTH][NUM_COUNTERS];                                                       \
        for (uint depth = 0; depth < num_levels; depth++)                                          \
            for (uint k = 0; k < NUM_COUNTERS; k++)                                                \
                counters[depth][k] = 0;                                                            \
        ulong rays = 0, simd_rays = 0, packets = 0, hits = 0;                                      \
        Packet p;                                                                                  \
        for (uint packet = get_global_id(0); packet < num_packets;                                 \
             packet += get_global_size(0)) {                                                       \
            for (uint place = 0; place < packet_side * packet_side; place++)                       \
                for (uint lane = 0; lane < WIDTH; lane++) {                                        \
                    const uint ray = ray_at(&stream, packet, place, lane);                         \
                    if (ray != INVALID)                                                            \
                        result[ray] = NONE;                                                        \
                }                                                                                  \
            load_packet(&p, &stream, packet, size);                                                \
            if (p.count == 0)                                                                      \
                continue;                                                                          \
            p.frustum.valid = false;                                                               \
            p.least_active = least_active;                                                           \
            if (least_active)                                                                         \
                bound_packet(&p.frustum, p.rays, p.count, p.direction,                             \
                             width != 0 && p.count == packet_side * packet_side ? packet_side : 0, \
                             root.low, root.high);                                                 \
            traverse(&p, traversal, nodes, triangles, ANY_HIT, counters);                          \
            packets++;                                                                             \
            simd_rays += p.count;                                                                  \
            for (uint i = 0; i < p.count; i++) {                                                   \
                const SimdRay *r = p.rays + i;                                                     \
                rays += COUNT16(r->live);                                                          \
                float t[WIDTH] __attribute__((aligned(64)));                                       \
                uint id[WIDTH] __attribute__((aligned(64))),                                       \
                    ray[WIDTH] __attribute__((aligned(64)));                                       \
                *(VF *)t = r->t, *(VU *)id = r->triangle, *(VU *)ray = r->ray;                     \
                for (uint found = MASK_V(r->triangle != INVALID); found; found &= found - 1) {     \
                    const uint lane = LOWEST(found);                                               \
                    hits++;                                                                        \
                    result[ray[lane]] = FOUND;                                                     \
                }                                                                                  \
            }                                                                                      \
        }                                                                                          \
        global ulong *mine = totals + 4 * (ulong)get_global_id(0);                                 \
        mine[0] = rays, mine[1] = simd_rays, mine[2] = packets, mine[3] = hits;                    \
        for (uint depth = 0; depth < num_levels; depth++)                                          \
            for (uint k = 0; k < NUM_COUNTERS; k++)                                                \
                counts[(get_global_id(0) * num_levels + depth) * NUM_COUNTERS + k]                 \
                    = counters[depth][k];                                                          \
    }

DEFINE_PACKET_KERNEL(intersect_packets, ulong, MISS, false, hit_key(t[lane], id[lane]))
DEFINE_PACKET_KERNEL(occlude_packets, uchar, 0, true, 1)
