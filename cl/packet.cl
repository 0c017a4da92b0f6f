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
// Build-time constants: WIDTH (4 or 16), DEPTH (levels of the tree at most), LEAF_SIZE, NUM_COUNTERS, MASKED, RANGED,
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
    uint least_active; // the frustum is asked where so many SIMD rays are; 0: never
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

// The rays in the lanes of the SIMD ray at a place of a packet; INVALID where there is none.
inline VU rays_at(const Stream *s, uint packet, uint place)
{
    if (s->width == 0) {
        const ulong first = ((ulong)packet * s->packet_side * s->packet_side + place) * WIDTH;
        const VU ray = (uint)first + LANES;
        return first + WIDTH <= s->num_rays ? ray : (ray < s->num_rays ? ray : (VU)INVALID);
    }
    const uint size = s->packet_side * SIDE, tiles = (s->width + size - 1) / size;
    const uint row = place / s->packet_side;
    const VU x = packet % tiles * size + (place - row * s->packet_side) * SIDE + (LANES & (SIDE - 1));
    const VU y = packet / tiles * size + row * SIDE + LANES / SIDE;
    return ((x < s->width) & (y < s->height)) ? y * s->width + x : (VU)INVALID;
}

// Loads the SIMD ray at a place of a packet; false, and only its rays are set, if no lane is live.
inline bool load_simd_ray(const Stream *s, uint packet, uint place, float size, SimdRay *r)
{
    r->ray = rays_at(s, packet, place);
    r->triangle = INVALID;
    uint rays[WIDTH] __attribute__((aligned(64)));
    *(VU *)rays = r->ray;
    float4 origins[WIDTH] __attribute__((aligned(64)));
    float4 directions[WIDTH] __attribute__((aligned(64)));
    for (uint lane = 0; lane < WIDTH; lane++) {
        const uint ray = rays[lane] == INVALID ? 0 : rays[lane];
        if (lane % SIDE == 0) { // the rows below are read soon
            PREFETCH(s->org_tnear + ray + SIDE * (ulong)s->width);
            PREFETCH(s->dir_tfar + ray + SIDE * (ulong)s->width);
        }
        origins[lane] = s->org_tnear[ray];
        directions[lane] = s->dir_tfar[ray];
    }
    VF o[3], d[3], tnear, tfar;
    TRANSPOSE(origins, o[0], o[1], o[2], tnear)
    TRANSPOSE(directions, d[0], d[1], d[2], tfar)
    const VI live = (r->ray != INVALID) & (tfar >= tnear)
                    & ((d[0] != 0.0f) | (d[1] != 0.0f) | (d[2] != 0.0f));
    r->live = MASK_V(live);
    if (r->live == 0)
        return false;
    set_up(r, o, d, tnear, tfar, live, size);
    return true;
}

// What is common to the rays of a packet: order of children, frustum, first order of the rays.
inline void prepare(Packet *p, uint side, float4 scene_low, float4 scene_high)
{
    VF total[3] = {0.0f, 0.0f, 0.0f};
    for (uint i = 0; i < p->count; i++) {
        for (uint axis = 0; axis < 3; axis++)
            total[axis] += CHOOSE(live_lanes(p->rays + i), p->rays[i].unit[axis], 0.0f);
        p->indices[i] = i;
    }
    for (uint axis = 0; axis < 3; axis++)
        p->direction[axis] = sum_lanes(total[axis]);
    p->frustum.valid = false;
    if (p->least_active != 0 && p->count >= p->least_active) // else no one would ask
        bound_packet(&p->frustum, p->rays, p->count, p->direction, side, scene_low, scene_high);
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
        // Dead ones are swapped, too, which changes nothing: a branch here is mispredicted half of the time.
        const uchar place = p->indices[i], other = p->indices[ie];
        const bool alive = meet(p->rays + place, cell->low, cell->high) != 0;
        p->indices[i] = other;
        p->indices[ie] = place;
        ie += alive;
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
inline void visit_leaf(Packet *p, uint traversal, const Node *cell, const uchar *active,
                       uint num_active, global const float4 *triangles, bool any_hit,
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
        // Masked and Partition have tested them all.
        COUNT(ALIVE, traversal != RANGED || meet(r, cell->low, cell->high));
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
        if (IS_LEAF(node))
            PREFETCH(triangles + TRIANGLE_FLOAT4S * (ulong)LEAF_FIRST(node));
        else
            PREFETCH((global const float4 *)(nodes + LEFT_CHILD(node)));
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
            visit_leaf(p, traversal, &node, partition ? p->indices : p->active,
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

// Where results go: hits, or flags.
typedef struct {
    global const float4 *triangles; // by their numbers
    global float *t, *u, *v;
    global uint *triangle;
    global uchar *blocked;
} Results;

inline void scatter(VU ray, VU values, global uint *to)
{
    uint rays[WIDTH] __attribute__((aligned(64))), lanes[WIDTH] __attribute__((aligned(64)));
    *(VU *)rays = ray, *(VU *)lanes = values;
    const bool whole = MASK_V(ray == INVALID) == 0;
    for (uint lane = 0; lane < WIDTH; lane += SIDE)
        if (whole) // rows of a square, or rays in order
            STORE_ROW(to + rays[lane], lanes + lane);
        else
            for (uint k = lane; k < lane + SIDE; k++)
                if (rays[k] != INVALID)
                    to[rays[k]] = lanes[k];
}

// Hits as cl/intersect.cl resolves them: inf, INVALID, 0, 0 where missed.
inline void store_hits(const SimdRay *r, const Results *results)
{
    const VI hit = r->triangle != INVALID;
    VHit h = {INFINITY, 0.0f, 0.0f, 0};
    if (MASK_V(hit)) {
        h = hit_again(r, results->triangles);
        h.t = CHOOSE(hit, h.t, INFINITY), h.u = CHOOSE(hit, h.u, 0.0f), h.v = CHOOSE(hit, h.v, 0.0f);
    }
    scatter(r->ray, AS_VU(h.t), (global uint *)results->t);
    scatter(r->ray, AS_VU(h.u), (global uint *)results->u);
    scatter(r->ray, AS_VU(h.v), (global uint *)results->v);
    scatter(r->ray, r->triangle, results->triangle);
}

inline void store_blocked(const SimdRay *r, global uchar *blocked)
{
    uint rays[WIDTH] __attribute__((aligned(64)));
    *(VU *)rays = r->ray;
    const uint hit = MASK_V(r->triangle != INVALID);
    for (uint lane = 0; lane < WIDTH; lane++)
        if (rays[lane] != INVALID)
            blocked[rays[lane]] = hit >> lane & 1;
}

inline void store(const SimdRay *r, bool any_hit, const Results *results)
{
    if (any_hit)
        store_blocked(r, results->blocked);
    else
        store_hits(r, results);
}

// Loads the SIMD rays of a packet that have a live lane.
inline void load_packet(Packet *p, const Stream *s, uint packet, float size, bool any_hit,
                        const Results *results)
{
    p->count = 0;
    for (uint place = 0; place < s->packet_side * s->packet_side; place++) {
        SimdRay *r = p->rays + p->count;
        if (load_simd_ray(s, packet, place, size, r))
            p->count++;
        else
            store(r, any_hit, results);
    }
}

// Work-item g takes the packets g, g + global size, ...; totals[g] are its rays, SIMD rays, packets and
// rays that hit, counts[g] what it counted by depth.
inline void trace_packets(const Stream *stream, uint num_packets, uint traversal, uint least_active,
                          uint num_levels, global const Node *nodes,
                          global const float4 *triangles, bool any_hit, const Results *results,
                          global ulong *totals, global ulong *counts)
{
    const Node root = nodes[0];
    const uint whole = stream->packet_side * stream->packet_side;
    ulong counters[DEPTH][NUM_COUNTERS];
    for (uint depth = 0; depth < num_levels; depth++)
        for (uint k = 0; k < NUM_COUNTERS; k++)
            counters[depth][k] = 0;
    ulong rays = 0, simd_rays = 0, packets = 0, hits = 0;
    Packet p;
    p.least_active = least_active;
    for (uint packet = get_global_id(0); packet < num_packets; packet += get_global_size(0)) {
        load_packet(&p, stream, packet, box_size(root.low, root.high), any_hit, results);
        if (p.count == 0)
            continue;
        const bool tile = stream->width != 0 && p.count == whole;
        prepare(&p, tile ? stream->packet_side : 0, root.low, root.high);
        traverse(&p, traversal, nodes, triangles, any_hit, counters);
        packets++;
        simd_rays += p.count;
        for (uint i = 0; i < p.count; i++) {
            rays += COUNT16(p.rays[i].live);
            hits += COUNT16(MASK_V(p.rays[i].triangle != INVALID));
            store(p.rays + i, any_hit, results);
        }
    }
    global ulong *mine = totals + 4 * (ulong)get_global_id(0);
    mine[0] = rays, mine[1] = simd_rays, mine[2] = packets, mine[3] = hits;
    for (uint depth = 0; depth < num_levels; depth++)
        for (uint k = 0; k < NUM_COUNTERS; k++)
            counts[(get_global_id(0) * num_levels + depth) * NUM_COUNTERS + k] = counters[depth][k];
}

#define STREAM_AND_TREE                                                                            \
    const uint num_packets, const uint num_rays, const uint width, const uint height,              \
        const uint packet_side, const uint traversal, const uint least_active,                     \
        const uint num_levels, global const Node *restrict nodes,                                  \
        global const float4 *restrict triangles, global const float4 *restrict org_tnear,          \
        global const float4 *restrict dir_tfar

kernel void intersect_packets(STREAM_AND_TREE, global const float4 *restrict numbered,
                              global float *restrict t, global uint *restrict triangle,
                              global float *restrict u, global float *restrict v,
                              global ulong *restrict totals, global ulong *restrict counts)
{
    const Stream stream = {num_rays, width, height, packet_side, org_tnear, dir_tfar};
    const Results results = {numbered, t, u, v, triangle, 0};
    trace_packets(&stream, num_packets, traversal, least_active, num_levels, nodes, triangles,
                  false, &results, totals, counts);
}

kernel void occlude_packets(STREAM_AND_TREE, global uchar *restrict blocked,
                            global ulong *restrict totals, global ulong *restrict counts)
{
    const Stream stream = {num_rays, width, height, packet_side, org_tnear, dir_tfar};
    const Results results = {0, 0, 0, 0, 0, blocked};
    trace_packets(&stream, num_packets, traversal, least_active, num_levels, nodes, triangles, true,
                  &results, totals, counts);
}
