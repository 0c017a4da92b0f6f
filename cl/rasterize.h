// A triangle on the screen: its corners in view space, its bounding box, and the exact test of
// whether it covers a pixel. Used by rasterize.cl, whose head explains the method.

#include "common.h"

#define ROUNDING 0x1p-24f
// Depths up to this part of the triangle's largest are rounding noise: the near plane.
#define NEAR 0x1p-20f
// Pixels that a bounding box is enlarged by; positions are rounded by 0.01 on a screen of 65535.
#define MARGIN 0x1p-6f
#define EMPTY_BOX (int4)(1, 1, 0, 0)

// x, y, z: the axes' images in view space, (X, Y, Z) of p - eye. They hold the focal length and the
// direction of rows, so that the pixel of p is (X/Z, Y/Z) + centre. size: of the screen in pixels.
typedef struct {
    float4 eye, x, y, z;
    float2 centre;
    int2 size;
} View;

typedef struct {
    float4 a, b, c;  // corners in view space
} Triangle;

inline View make_view(float16 axes, float2 centre, int2 size)
{
    const View view = {axes.s0123, axes.s4567, axes.s89ab, axes.scdef, centre, size};
    return view;
}

inline float4 to_view(const View *view, float4 p)
{
    p -= view->eye;
    return p.x * view->x + p.y * view->y + p.z * view->z;
}

inline Triangle load_triangle(const View *view, global const float4 *triangles, uint i)
{
    const global float4 *corner = triangles + 3 * (size_t)i;
    const Triangle t = {to_view(view, corner[0]), to_view(view, corner[1]),
                        to_view(view, corner[2])};
    return t;
}

inline float absolute(float x) { return x < 0.0f ? -x : x; }

inline float near_plane(const Triangle *t)
{
    const float a = absolute(t->a.z), b = absolute(t->b.z), c = absolute(t->c.z);
    const float ab = MAX(a, b);
    return NEAR * MAX(ab, c);
}

// ---- bounding boxes ----

// Boxes are (-left, -top, right, bottom), so that growing is one maximum.
inline float4 grow(float4 box, float4 p, float pad)
{
    const float4 q = (float4)(-p.xy, p.xy) / p.z + pad;
    return box > q ? box : q;
}

// The part of an edge before the near plane: its first corner, and the point where it crosses. That
// point is uncertain by a few roundings of the larger corner over the depth of the plane.
inline float4 grow_clipped(float4 box, float4 a, float4 b, float near)
{
    if (a.z > near)
        box = grow(box, a, MARGIN);
    if ((a.z > near) != (b.z > near)) {
        const float4 p = a + (near - a.z) / (b.z - a.z) * (b - a);
        const float ax = absolute(a.x), ay = absolute(a.y), bx = absolute(b.x), by = absolute(b.y);
        box = grow(box, (float4)(p.xy, near, 0.0f),
                   MARGIN + 8.0f * ROUNDING * (ax + ay + bx + by) / near);
    }
    return box;
}

// The pixels (left, top, right, bottom), inclusive, whose centres the triangle can cover.
inline int4 pixel_bounds(const Triangle *t, const View *view)
{
    const float near = near_plane(t);
    const float4 sum = t->a + t->b + t->c, none = sum - sum;
    if (!(none.x + none.y + none.z == 0.0f))  // a coordinate is not finite
        return EMPTY_BOX;
    float4 box = -INFINITY;
    if (t->a.z > near && t->b.z > near && t->c.z > near) {
        box = grow(grow(grow(box, t->a, MARGIN), t->b, MARGIN), t->c, MARGIN);
    } else {
        box = grow_clipped(box, t->a, t->b, near);
        box = grow_clipped(box, t->b, t->c, near);
        box = grow_clipped(box, t->c, t->a, near);
    }
    const float2 size = convert_float2(view->size);
    const float4 low = (float4)(-size, -1.0f, -1.0f), high = (float4)(0.0f, 0.0f, size - 1.0f);
    box += (float4)(-view->centre, view->centre);
    box = box > low ? box : low;
    box = box < high ? box : high;
    int4 floor = convert_int4(box);
    floor += box < convert_float4(floor);  // towards minus infinity: true is -1
    floor.xy = -floor.xy;
    return floor.x > floor.z || floor.y > floor.w ? EMPTY_BOX : floor;
}

// ---- exact coverage ----

// Position of a pixel's ray on the screen, from the point straight ahead.
inline float2 ray_at(const View *view, int column, int row)
{
    return (float2)(column, row) - view->centre;
}

// A corner seen from `ray`; rounded alike for every triangle that has the corner.
inline float4 around(float4 a, float2 ray)
{
    return (float4)(a.xy - ray * a.z, a.z, 0.0f);
}

// a*b - c*d with the exact sign: rounding is monotonic, so unequal products have the sign of their
// difference, and equal ones differ by their rounding errors.
inline float difference(float a, float b, float c, float d)
{
    const float p = a * b, q = c * d;
    return p != q ? p - q : FMA(a, b, -p) - FMA(c, d, -q);
}

// Sign of the function of the edge a, b at the origin, with value e; zero as if at (e, e*e).
inline int edge_sign(float e, float4 a, float4 b)
{
    if (e == 0.0f)
        e = difference(a.y, b.z, a.z, b.y);
    if (e == 0.0f)
        e = difference(a.z, b.x, a.x, b.z);
    return (e > 0.0f) - (e < 0.0f);
}

// The three edge functions at the ray, with w = 1 where it meets the triangle, by exact signs.
inline float4 exact_coverage(const Triangle *t, float2 ray)
{
    const float4 a = around(t->a, ray), b = around(t->b, ray), c = around(t->c, ray);
    const float e0 = difference(b.x, c.y, b.y, c.x);
    const float e1 = difference(c.x, a.y, c.y, a.x);
    const float e2 = difference(a.x, b.y, a.y, b.x);
    const int s0 = edge_sign(e0, b, c), s1 = edge_sign(e1, c, a), s2 = edge_sign(e2, a, b);
    return (float4)(e0, e1, e2, s0 == s1 && s1 == s2 ? 1.0f : 0.0f);
}
