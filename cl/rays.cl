// Packing a caller's ray arrays, already on the device, into the ray layout of all tracers:
// org_tnear (origin, tnear) and dir_tfar (direction, tfar), a float4 each.
//
// `first_invalid` is set to the smallest index of a ray that no tracer can take: a value that is NaN,
// an origin or direction that is infinite, a zero direction, a negative tnear.

#include "common.h"

inline bool is_number(float x) { return x == x; }
inline bool is_finite(float x) { return is_number(x) && x - x == 0.0f; }

kernel void pack_rays(const uint num_rays, global const float *restrict origins,
                      global const float *restrict directions, global const float *restrict tnear,
                      const uint tnear_stride, global const float *restrict tfar,
                      const uint tfar_stride, global float4 *restrict org_tnear,
                      global float4 *restrict dir_tfar, global uint *restrict first_invalid)
{
    const uint i = get_global_id(0);
    if (i >= num_rays)
        return;
    global const float *o = origins + 3 * (ulong)i, *d = directions + 3 * (ulong)i;
    const float near = tnear[(ulong)i * tnear_stride], far = tfar[(ulong)i * tfar_stride];
    org_tnear[i] = (float4)(o[0], o[1], o[2], near);
    dir_tfar[i] = (float4)(d[0], d[1], d[2], far);
    const bool finite = is_finite(o[0]) && is_finite(o[1]) && is_finite(o[2]) && is_finite(d[0])
                        && is_finite(d[1]) && is_finite(d[2]);
    const bool direction = d[0] != 0.0f || d[1] != 0.0f || d[2] != 0.0f;
    if (!(finite && direction && near >= 0.0f && is_number(far)))
        atomic_min(first_invalid, i);
}

// Rays from the camera through every pixel, row by row from the top: direction = forward + sx right
// + sy up, not normalised, so that t is the depth. `right` and `up` hold the half extents of the image
// plane at distance 1; `offset` is the sample's place in its pixel.
kernel void camera_rays(const uint width, const uint height, const float2 offset, const float4 eye,
                        const float4 right, const float4 up, const float4 forward,
                        global float4 *restrict org_tnear, global float4 *restrict dir_tfar)
{
    const uint i = get_global_id(0);
    if (i >= width * height)
        return;
    const float sx = 2.0f * ((float)(i % width) + offset.x) / (float)width - 1.0f;
    const float sy = 1.0f - 2.0f * ((float)(i / width) + offset.y) / (float)height;
    float4 direction = forward + sx * right + sy * up;
    direction.w = INFINITY;
    org_tnear[i] = eye;
    dir_tfar[i] = direction;
}
