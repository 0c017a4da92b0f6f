// The bounds of a triangle, as cl/geometry.cl makes them: three float4,
//   bounding sphere (centre P, radius d), slab (n, e): |n.(x - P)| <= e, box (b, 0): |x - P| <= b,
// for all points x of the triangle; or the same as rows of sixteen triangles.

#define BOUND_FLOAT4S 3
#define BOUND_ROWS 12
#define RADIUS_SLACK (1.0f + 0x1p-20f) // 16 roundings, u = 2^-24 each
