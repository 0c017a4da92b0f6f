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

// A ray against boxes: enter and leave a plane at s = plane * inverse + near, + far.
typedef struct {
    float inverse[3], per_t; // s = per_t * t
    float near[3], begin;    // of the ray, in s
    float far[3], end;
    uint low_row[4]; // of a node, the plane at which the ray enters
} __attribute__((aligned(64))) BoxRay;

inline void set_box_ray(BoxRay *r, const Box *scene, float4 org_tnear, float4 dir_tfar)
{
    const float4 o = org_tnear, d = dir_tfar;
    const float4 below = size_of4(scene->low - o), above = size_of4(scene->high - o);
    const float per_t = largest3(size_of4(d)), reach = largest3(below > above ? below : above);
    const float slack = 0x1p-18f * reach + 0x1p-22f * largest3(size_of4(o));
    const float4 slope = d / per_t, size = size_of4(slope);
    const float4 unsigned_inverse = 1.0f / (size < STILL ? (float4)STILL : size);
    const int4 falls = slope < 0.0f;
    const float4 inverse = falls ? -unsigned_inverse : unsigned_inverse;
    const float4 shift = -o * inverse, widening = slack * unsigned_inverse;
    float4 near = shift - widening, far = shift + widening;
    near.w = org_tnear.w * per_t / OUTWARDS + 0.0f;
    far.w = MIN(dir_tfar.w, MAXFLOAT) * per_t * OUTWARDS;
    *(float4 *)r->inverse = (float4)(inverse.xyz, per_t);
    *(float4 *)r->near = near;
    *(float4 *)r->far = far;
    *(int4 *)r->low_row = (int4)(0, 1, 2, 0) + (falls & 3);
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
