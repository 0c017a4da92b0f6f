// Bounding spheres of objects, runs of an order of the triangles (Reis et al. 2017, sections 3.3.1
// and 3.3.7), and the order whose runs are compact clusters.
//
// Smallest balls by the pivoting of Gaertner (1999), whose program the paper takes: find the vertex
// farthest from the centre, take the smallest ball around it and the up to four vertices that held
// the last ball, again. A pass reads every vertex once; the best centre measured is kept, so any
// fixed number of passes is safe. Sixteen balls are moved at once, one to a lane. The first centre
// and support is the middle of the box. It takes part like a vertex: the smallest ball (C, r) holds
// it, since on each axis low <= C <= high, low >= C - r and high <= C + r put it within r / 2 of C.
//
// Rounding: a pass measures from the centre as it will be stored, so that only the rounding of that
// distance counts. With u = 2^-24: differences u, the sum of their squares then 5 u, half of that
// after the root, the root itself 6 u, the last product u: below 10 u, and RADIUS_SLACK adds 16 u.
// Lengths are divided by a power of two near the object's size: no square overflows, and none that
// counts underflows.
//
// Layouts: triangles, bounds and bound rows in cl/geometry.cl. Object rows are like bound rows:
//   object_rows   per block of 16 objects four float16 rows: centre x, y, z, radius
// Vertex rows are three float16 for every 16 vertices: x, y, z.
//
// Build-time constant: CHUNKS.

#include "bounds.h"
#include "hilbert.h"
#include "triangle.h"

#define SUPPORT 4 // vertices that hold a ball
#define AHEAD 4 // steps that gathers look ahead: sorted triangles lie all over memory

// Sixteen points or vectors.
typedef struct {
    float16 x, y, z;
} Points;

inline Points load_points(global const float16 *rows)
{
    const Points p = {rows[0], rows[1], rows[2]};
    return p;
}

inline void store_points(global float16 *rows, Points p)
{
    rows[0] = p.x;
    rows[1] = p.y;
    rows[2] = p.z;
}

inline Points choose(int16 mask, Points a, Points b)
{
    const Points p = {mask ? a.x : b.x, mask ? a.y : b.y, mask ? a.z : b.z};
    return p;
}

inline Points subtract(Points a, Points b)
{
    const Points p = {a.x - b.x, a.y - b.y, a.z - b.z};
    return p;
}

inline Points scaled(Points a, float16 factor)
{
    const Points p = {a.x * factor, a.y * factor, a.z * factor};
    return p;
}

inline Points cross_points(Points a, Points b)
{
    const Points p = {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
    return p;
}

inline float16 dot_points(Points a, Points b)
{
    return FMA16(a.x, b.x, FMA16(a.y, b.y, a.z * b.z));
}

// --- boxes --------------------------------------------------------------------------------------

typedef struct {
    Points low, high;
} Boxes;

inline Boxes empty_boxes(void)
{
    const Boxes b = {{INFINITY, INFINITY, INFINITY}, {-INFINITY, -INFINITY, -INFINITY}};
    return b;
}

inline Boxes extend(Boxes b, Points p)
{
    const Boxes wider = {{p.x < b.low.x ? p.x : b.low.x, p.y < b.low.y ? p.y : b.low.y,
                          p.z < b.low.z ? p.z : b.low.z},
                         {p.x > b.high.x ? p.x : b.high.x, p.y > b.high.y ? p.y : b.high.y,
                          p.z > b.high.z ? p.z : b.high.z}};
    return wider;
}

inline Boxes bound_vertices(global const float16 *rows, uint count)
{
    Boxes boxes = empty_boxes();
    for (uint k = 0; k < count; k++)
        boxes = extend(boxes, load_points(rows + 3 * k));
    return boxes;
}

// The box around all sixteen: its low corner to corners[0], its high corner to corners[1].
inline void store_box(global float4 *corners, Boxes b)
{
    corners[0] = -(float4)(highest(-b.low.x), highest(-b.low.y), highest(-b.low.z), 0.0f);
    corners[1] = (float4)(highest(b.high.x), highest(b.high.y), highest(b.high.z), 0.0f);
}

// --- smallest balls -----------------------------------------------------------------------------

// Sixteen balls on their way: 20 float16.
typedef struct {
    Points centre;        // to be measured next
    Points best;          // the centre whose farthest vertex was the nearest
    float16 best_squared; // its squared distance, scaled; infinite before the first pass
    Points support[SUPPORT];
    float16 scale; // 1 / a power of two near the size
} Balls;

// The exponent is taken from the bits: no rounding. Clamped so that neither the scale nor its
// reciprocal leaves the normal numbers.
inline float16 scale_of(float16 size)
{
    const int16 exponent = as_int16(size) >> 23;
    return as_float16((253 - (exponent < 252 ? exponent : 252)) << 23);
}

inline Balls start_in_boxes(Boxes b)
{
    const Points low = scaled(b.low, 0.5f), high = scaled(b.high, 0.5f);
    const Points half_size = subtract(high, low); // of halves: the whole may overflow
    const float16 xy = half_size.x > half_size.y ? half_size.x : half_size.y;
    Balls balls;
    balls.centre.x = low.x + high.x;
    balls.centre.y = low.y + high.y;
    balls.centre.z = low.z + high.z;
    balls.best = balls.centre;
    balls.best_squared = INFINITY;
    balls.scale = scale_of(xy > half_size.z ? xy : half_size.z);
    for (uint j = 0; j < SUPPORT; j++)
        balls.support[j] = balls.centre;
    return balls;
}

typedef struct {
    Points vertex;
    float16 squared; // scaled; -1 where no distance is a number, -inf where there is no vertex
} Farthest;

// Lane by lane the vertex farthest from the lane's centre, the first of equals.
inline Farthest find_farthest(global const float16 *rows, uint count, Points centre, float16 scale)
{
    Farthest f = {{0.0f, 0.0f, 0.0f}, -1.0f};
    for (uint k = 0; k < count; k++) {
        const Points p = load_points(rows + 3 * k);
        const Points offset = scaled(subtract(p, centre), scale);
        const float16 squared = dot_points(offset, offset);
        const int16 farther = squared > f.squared;
        f.vertex = choose(farther, p, f.vertex);
        f.squared = farther ? squared : f.squared;
    }
    return f;
}

// The smallest ball so far around the origin and four points, and which of these it goes through.
typedef struct {
    Points centre;
    float16 squared;
    int16 through; // bit j: point j
} Smallest;

// A centre with its largest distance: one made by ill-conditioned arithmetic, or NaN, is not taken.
inline void consider(Smallest *s, Points centre, const Points *points, int through)
{
    float16 squared = dot_points(centre, centre);
    for (uint j = 0; j < SUPPORT; j++) {
        const Points offset = subtract(centre, points[j]);
        const float16 other = dot_points(offset, offset);
        squared = other > squared ? other : squared;
    }
    const int16 smaller = squared < s->squared;
    s->centre = choose(smaller, centre, s->centre);
    s->squared = smaller ? squared : s->squared;
    s->through = smaller ? (int16)through : s->through;
}

// Centre of the circle through the origin, a and b.
inline Points circle_centre(Points a, Points b)
{
    const Points n = cross_points(a, b);
    const Points m = subtract(scaled(b, dot_points(a, a)), scaled(a, dot_points(b, b)));
    return scaled(cross_points(m, n), 0.5f / dot_points(n, n));
}

// Centre of the sphere through the origin, a, b and c.
inline Points sphere_centre(Points a, Points b, Points c)
{
    const Points bc = cross_points(b, c);
    const Points k = scaled(bc, dot_points(a, a));
    const Points l = scaled(cross_points(a, c), dot_points(b, b));
    const Points m = scaled(cross_points(a, b), -dot_points(c, c));
    return scaled(subtract(subtract(k, l), m), 0.5f / dot_points(a, bc));
}

// The smallest ball goes through the new vertex, the origin, and one to three of the others.
inline Smallest enclose_with_origin(const Points *a, Points start)
{
    Smallest s = {start, INFINITY, 0};
    for (int j = 0; j < SUPPORT; j++)
        consider(&s, scaled(a[j], 0.5f), a, 1 << j);
    for (int j = 0; j < SUPPORT; j++) {
        for (int i = 0; i < j; i++)
            consider(&s, circle_centre(a[i], a[j]), a, 1 << i | 1 << j);
    }
    consider(&s, sphere_centre(a[0], a[1], a[2]), a, 7);
    consider(&s, sphere_centre(a[0], a[1], a[3]), a, 11);
    consider(&s, sphere_centre(a[0], a[2], a[3]), a, 13);
    consider(&s, sphere_centre(a[1], a[2], a[3]), a, 14);
    return s;
}

// The end of a pass. A support of fewer than four holds one of its vertices several times.
inline void move_centres(Balls *b, Farthest f)
{
    const int16 better = (f.squared >= 0.0f) & (f.squared < b->best_squared);
    b->best = choose(better, b->centre, b->best);
    b->best_squared = better ? f.squared : b->best_squared;
    Points offsets[SUPPORT];
    for (uint j = 0; j < SUPPORT; j++)
        offsets[j] = scaled(subtract(b->support[j], f.vertex), b->scale);
    const Points start = scaled(subtract(b->centre, f.vertex), b->scale);
    const Smallest s = enclose_with_origin(offsets, start);
    for (uint j = 0; j < SUPPORT; j++)
        b->support[j] = choose((s.through & (1 << j)) != 0, b->support[j], f.vertex);
    const Points moved = scaled(s.centre, 1.0f / b->scale);
    b->centre.x = f.vertex.x + moved.x;
    b->centre.y = f.vertex.y + moved.y;
    b->centre.z = f.vertex.z + moved.z;
}

// Objects that are not `used` have no triangles.
inline void store_spheres(global float16 *rows, const Balls *b, int16 used)
{
    store_points(rows, b->best);
    rows[3] = used ? sqrt(b->best_squared) / b->scale * RADIUS_SLACK : -INFINITY;
}

// --- meshes: runs of vertices, so that a large one is shared by many work-items -----------------

// One work-item: the vertices of groups run_groups[r] .. run_groups[r + 1] - 1 as rows, and their
// box. `corners`: 16 a group, a vertex of the mesh once, as a float4 of `triangles`.
kernel void gather_run(const uint num_runs, global const uint *restrict run_groups,
                       global const uint *restrict corners, global const float4 *restrict triangles,
                       global float16 *restrict rows, global float4 *restrict boxes)
{
    const uint run = get_global_id(0);
    if (run >= num_runs)
        return;
    const uint begin = run_groups[run], end = run_groups[run + 1];
    for (uint group = begin; group < end; group++) {
        float4 s[16] __attribute__((aligned(64)));
        for (uint lane = 0; lane < 16; lane++)
            s[lane] = triangles[corners[16 * (ulong)group + lane]];
        Points p;
        float16 unused;
        TRANSPOSE16(s, p.x, p.y, p.z, unused);
        store_points(rows + 3 * (ulong)group, p);
    }
    store_box(boxes + 2 * (ulong)run, bound_vertices(rows + 3 * (ulong)begin, end - begin));
}

// One work-item starts 16 meshes; mesh i has runs first_runs[i] .. first_runs[i + 1] - 1.
kernel void start_balls(const uint num_objects, global const uint *restrict first_runs,
                        global const float4 *restrict boxes, global Balls *restrict balls)
{
    const uint block = get_global_id(0);
    float low[3][16] __attribute__((aligned(64))) = {{0.0f}};
    float high[3][16] __attribute__((aligned(64))) = {{0.0f}};
    for (uint lane = 0; lane < 16 && block * 16 + lane < num_objects; lane++) {
        const uint begin = first_runs[block * 16 + lane], end = first_runs[block * 16 + lane + 1];
        float4 l = INFINITY, h = -INFINITY;
        for (uint run = begin; run < end; run++) {
            l = boxes[2 * run] < l ? boxes[2 * run] : l;
            h = boxes[2 * run + 1] > h ? boxes[2 * run + 1] : h;
        }
        if (begin < end) {
            low[0][lane] = l.x, low[1][lane] = l.y, low[2][lane] = l.z;
            high[0][lane] = h.x, high[1][lane] = h.y, high[2][lane] = h.z;
        }
    }
    const Boxes b = {{*(float16 *)low[0], *(float16 *)low[1], *(float16 *)low[2]},
                     {*(float16 *)high[0], *(float16 *)high[1], *(float16 *)high[2]}};
    balls[block] = start_in_boxes(b);
}

// Vertex and squared distance of the lane with the largest, the first of equals.
inline float4 farthest_lane(Farthest f)
{
    float lanes[4][16] __attribute__((aligned(64)));
    *(float16 *)lanes[0] = f.vertex.x;
    *(float16 *)lanes[1] = f.vertex.y;
    *(float16 *)lanes[2] = f.vertex.z;
    *(float16 *)lanes[3] = f.squared;
    const uint lane = LOWEST(MASK16(f.squared == highest(f.squared)));
    return (float4)(lanes[0][lane], lanes[1][lane], lanes[2][lane], lanes[3][lane]);
}

inline float lane_of(global const float16 *v, uint lane) { return ((global const float *)v)[lane]; }

// One work-item finds one run's vertex that is farthest from the centre of its mesh.
kernel void measure_run(const uint num_runs, global const uint *restrict run_groups,
                        global const uint *restrict run_objects,
                        global const float16 *restrict rows, global const Balls *restrict balls,
                        global float4 *restrict farthest)
{
    const uint run = get_global_id(0);
    if (run >= num_runs)
        return;
    const uint begin = run_groups[run], end = run_groups[run + 1];
    global const Balls *ball = balls + run_objects[run] / 16;
    const uint lane = run_objects[run] % 16;
    const Points centre = {lane_of(&ball->centre.x, lane), lane_of(&ball->centre.y, lane),
                           lane_of(&ball->centre.z, lane)};
    farthest[run] = farthest_lane(find_farthest(rows + 3 * (ulong)begin, end - begin, centre,
                                                lane_of(&ball->scale, lane)));
}

// One work-item moves 16 meshes.
kernel void move_balls(const uint num_objects, global const uint *restrict first_runs,
                       global const float4 *restrict farthest, global Balls *restrict balls,
                       global float16 *restrict object_rows)
{
    const uint block = get_global_id(0);
    float4 s[16] __attribute__((aligned(64)));
    for (uint lane = 0; lane < 16; lane++) {
        const uint object = MIN(block * 16 + lane, num_objects);
        const uint end = first_runs[MIN(object + 1, num_objects)];
        s[lane] = (float4)(0.0f, 0.0f, 0.0f, -INFINITY);
        for (uint run = first_runs[object]; run < end; run++)
            s[lane] = farthest[run].w > s[lane].w ? farthest[run] : s[lane];
    }
    Farthest f;
    TRANSPOSE16(s, f.vertex.x, f.vertex.y, f.vertex.z, f.squared);
    Balls b = balls[block];
    move_centres(&b, f);
    balls[block] = b;
    store_spheres(object_rows + 4 * (ulong)block, &b, f.squared > -INFINITY);
}

// --- clusters -----------------------------------------------------------------------------------

#define CELL_BITS 10 // an axis
#define CLASS_SHIFT (3 * CELL_BITS)

// The box around the spheres' centres, a part from each of CHUNKS work-items.
kernel void bound_centres(const uint num_blocks, global const float16 *restrict bound_rows,
                          global float4 *restrict boxes)
{
    Boxes b = empty_boxes();
    for (uint block = chunk_begin(num_blocks), end = chunk_end(num_blocks); block < end; block++) {
        global const float16 *rows = bound_rows + BOUND_ROWS * (ulong)block;
        const Boxes wider = extend(b, load_points(rows));
        const int16 triangle = rows[3] >= 0.0f;
        b.low = choose(triangle, wider.low, b.low);
        b.high = choose(triangle, wider.high, b.high);
    }
    store_box(boxes + 2 * get_global_id(0), b);
}

// Cells of a cube. What is no number, where the cube's size is 0 or infinite, is in the last.
inline uint16 cell(float16 offset, float cells)
{
    const float16 place = offset * cells, most = (1 << CELL_BITS) - 1;
    return CONVERT(uint16, place < most ? place : most);
}

// Keys for the sort: the size class, and within it the place along the curve. A triangle much
// larger than a cluster would be (`oversize`, in units of the cube) blows up the one it gets into;
// such triangles are clustered among themselves, by powers of four.
kernel void make_keys(const uint num_blocks, const float oversize,
                      global const float16 *restrict bound_rows,
                      global const float4 *restrict boxes, global uint16 *restrict keys)
{
    float4 low, high;
    join_boxes(boxes, CHUNKS, &low, &high);
    const float4 size = high - low;
    const float largest = largest3(size);
    const float cells = (1 << CELL_BITS) / largest, limit = oversize * largest;
    for (uint block = chunk_begin(num_blocks), end = chunk_end(num_blocks); block < end; block++) {
        global const float16 *rows = bound_rows + BOUND_ROWS * (ulong)block;
        const uint16 place
            = hilbert_place(cell(rows[0] - low.x, cells), cell(rows[1] - low.y, cells),
                            cell(rows[2] - low.z, cells), CELL_BITS);
        const int16 larger = (rows[3] > limit) + (rows[3] > 4 * limit) + (rows[3] > 16 * limit);
        const uint16 key = as_uint16(-larger) << CLASS_SHIFT | place;
        keys[block] = rows[3] >= 0.0f ? key : (uint16)INVALID; // padding comes last
    }
}

// The sorted order and the bounds in it. Padding has kept its place.
kernel void arrange_bounds(const uint num_blocks, const uint num_triangles,
                           global const uint *restrict sorted, global const float4 *restrict bounds,
                           global uint *restrict order, global float16 *restrict bound_rows)
{
    for (uint block = chunk_begin(num_blocks), end = chunk_end(num_blocks); block < end; block++) {
        global float16 *rows = bound_rows + BOUND_ROWS * (ulong)block;
        const uint ahead = MIN(block + AHEAD, num_blocks - 1) * 16;
        for (uint lane = 0; lane < 16; lane++)
            PREFETCH(bounds + BOUND_FLOAT4S * (ulong)sorted[ahead + lane]);
        for (uint part = 0; part < BOUND_FLOAT4S; part++, rows += 4) {
            float4 s[16] __attribute__((aligned(64)));
            for (uint lane = 0; lane < 16; lane++)
                s[lane] = bounds[BOUND_FLOAT4S * (ulong)sorted[block * 16 + lane] + part];
            TRANSPOSE16(s, rows[0], rows[1], rows[2], rows[3]);
        }
        for (uint i = block * 16; i < block * 16 + 16; i++)
            order[i] = i < num_triangles ? sorted[i] : INVALID;
    }
}

// Vertices of clusters first .. first + 15, a lane each, to 3 * size vertex rows. Missing triangles
// of the last cluster, and clusters after it, repeat the last triangle.
inline void gather_clusters(uint num_triangles, uint size, uint first, global const uint *order,
                            global const float4 *triangles, global float16 *rows)
{
    for (uint k = 0; k < size; k++) {
        uint corners[16];
        for (uint lane = 0; lane < 16; lane++) {
            const ulong i = (first + lane) * (ulong)size + k;
            corners[lane] = TRIANGLE_FLOAT4S * order[MIN(i, num_triangles - 1)];
            PREFETCH(triangles + TRIANGLE_FLOAT4S * order[MIN(i + AHEAD, num_triangles - 1)]);
        }
        for (uint corner = 0; corner < 3; corner++) {
            float4 s[16] __attribute__((aligned(64)));
            for (uint lane = 0; lane < 16; lane++)
                s[lane] = triangles[corners[lane] + corner];
            Points p;
            float16 unused;
            TRANSPOSE16(s, p.x, p.y, p.z, unused);
            store_points(rows + 3 * (3 * k + corner), p);
        }
    }
}

// The spheres of clusters of `size` triangles, sixteen at a time.
// `scratch`: 9 * size float16 a chunk.
kernel void enclose_clusters(const uint num_triangles, const uint num_objects, const uint size,
                             const uint passes, global const uint *restrict order,
                             global const float4 *restrict triangles, global float16 *scratch,
                             global float16 *restrict object_rows)
{
    const uint num_blocks = (num_objects + 15) / 16;
    global float16 *rows = scratch + 9 * (ulong)size * get_global_id(0);
    const int16 lanes = (int16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    for (uint block = chunk_begin(num_blocks), end = chunk_end(num_blocks); block < end; block++) {
        gather_clusters(num_triangles, size, block * 16, order, triangles, rows);
        Balls b = start_in_boxes(bound_vertices(rows, 3 * size));
        for (uint pass = 0; pass < passes; pass++)
            move_centres(&b, find_farthest(rows, 3 * size, b.centre, b.scale));
        store_spheres(object_rows + 4 * (ulong)block, &b, lanes < (int)(num_objects - block * 16));
    }
}
