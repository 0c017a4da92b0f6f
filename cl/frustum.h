#include "packet.h"
typedef struct { bool valid; } Frustum;
inline bool frustum_culls_box(const Frustum *f, float4 low, float4 high) { return false; }
inline bool frustum_culls_triangle(const Frustum *f, global const float4 *v) { return false; }
inline float box_size(float4 low, float4 high)
{
    const float4 a = fabs(low), b = fabs(high);
    return MAX(MAX(MAX(a.x, a.y), a.z), MAX(MAX(b.x, b.y), b.z));
}
