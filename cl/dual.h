// What the traversals of `dual` share: a ray as the boxes of a tree (tree.h) see it.
//
// Boxes. A ray is measured in s = t * (largest |component| of its direction), so that it moves at most
// one unit of space per unit of s whatever its direction's length. Components below STILL are
// replaced by it: no infinity, no NaN, one rule for rays along the faces of boxes.
//
// Why no hit of the watertight test is lost, with u = 2^-24, R the largest |coordinate| of a corner
// of the scene's box seen from the ray's origin o, and O that of o itself. For a hit (t, u, v) the
// point P of the triangle is near the ray: |o + t d - P| < 32 u R along each axis (cl/ldc.cl). A
// component that was replaced moves the ray by less than 2 STILL R = u R. A plane's parameter is
// computed with an inverse within 2 u and two roundings, each of which stands for a move of the plane by
// u R or u O: the sum is below 40 u R + 3 u O. Every box is enlarged by 64 u R + 4 u O, so that s of the
// hit lies within the box's interval on each axis, whatever the other axes say. The ends of a ray are
// rounded outwards by more than their own rounding.

#include "tree.h"
#include "triangle.h"

#define STILL 0x1p-25f
#define OUTWARDS (1.0f + 0x1p-20f)

typedef struct {
    float low[3], high[3];
} Box;

// A ray against boxes: enter and leave a plane at s = plane * inverse + near, + far.
typedef struct {
    float inverse[3], near[3], far[3];
    float begin, end; // of the ray, in s
    float per_t;      // s = per_t * t
    uint low_row[3];  // of a node, the plane at which the ray enters
    uint unused;      // a cache line
} BoxRay;

inline Box scene_box(global const float8 *root)
{
    Box b;
    for (uint k = 0; k < 3; k++) {
        b.low[k] = lowest8(root[k]);
        b.high[k] = highest8(root[3 + k]);
    }
    return b;
}

inline BoxRay box_ray(const Box *scene, float4 org_tnear, float4 dir_tfar)
{
    const float o[3] = {org_tnear.x, org_tnear.y, org_tnear.z};
    const float d[3] = {dir_tfar.x, dir_tfar.y, dir_tfar.z};
    BoxRay r;
    r.per_t = 0.0f;
    float reach = 0.0f, offset = 0.0f;
    for (uint k = 0; k < 3; k++) {
        r.per_t = MAX(r.per_t, size_of(d[k]));
        offset = MAX(offset, size_of(o[k]));
        reach = MAX(reach, MAX(size_of(scene->low[k] - o[k]), size_of(scene->high[k] - o[k])));
    }
    const float slack = 0x1p-18f * reach + 0x1p-22f * offset;
    for (uint k = 0; k < 3; k++) {
        const float slope = d[k] / r.per_t, steep = size_of(slope) < STILL ? STILL : size_of(slope);
        const float inverse = 1.0f / steep;
        r.inverse[k] = slope < 0.0f ? -inverse : inverse;
        r.near[k] = -o[k] * r.inverse[k] - slack * inverse;
        r.far[k] = -o[k] * r.inverse[k] + slack * inverse;
        r.low_row[k] = slope < 0.0f ? 3 + k : k;
    }
    r.begin = org_tnear.w * r.per_t / OUTWARDS + 0.0f;
    r.end = MIN(dir_tfar.w, MAXFLOAT) * r.per_t * OUTWARDS;
    return r;
}

// Whether the ray enters each child, and where.
inline int8 enter_children(const BoxRay *r, global const float8 *node, float8 *enter)
{
    float8 a = r->begin, b = r->end;
    for (uint k = 0; k < 3; k++) {
        const float8 near = FMA8(node[r->low_row[k]], (float8)(r->inverse[k]), (float8)(r->near[k]));
        const float8 far
            = FMA8(node[2 * k + 3 - r->low_row[k]], (float8)(r->inverse[k]), (float8)(r->far[k]));
        a = near > a ? near : a;
        b = far < b ? far : b;
    }
    *enter = a;
    return a <= b;
}
