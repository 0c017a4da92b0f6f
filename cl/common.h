// Shared by every file of cl/: rounding rules, constants, small vector helpers.
//
// Contraction is off, so that a*b+c rounds twice here as in numpy; where one rounding is wanted,
// fma() says so. The built-in min, max, fabs, clamp are not used in hot code: PoCL calls them out of
// line (ten times slower than ?:).

#pragma OPENCL FP_CONTRACT OFF

#include "simd.h"

#define INVALID 0xffffffffu

// For what works on vectors in private memory: PoCL leaves large functions calls, which pass them
// through memory.
#define INLINE inline __attribute__((always_inline))

#define CONCAT_(a, b) a##b
#define CONCAT(a, b) CONCAT_(a, b)

#define MIN(a, b) ((a) < (b) ? (a) : (b))
#define MAX(a, b) ((a) > (b) ? (a) : (b))

// dot and cross of float4 whose w is not meant.
inline float dot3(float4 a, float4 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

inline float4 cross3(float4 a, float4 b)
{
    return (float4)(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x, 0.0f);
}

inline float16 magnitude(float16 x) { return as_float16(as_int16(x) & 0x7fffffff); }

inline float16 larger(float16 a, float16 b) { return a > b ? a : b; }

inline float8 larger8(float8 a, float8 b) { return a > b ? a : b; }

inline float8 smaller8(float8 a, float8 b) { return a < b ? a : b; }

inline float size_of(float v) { return v < 0.0f ? -v : v; }

inline float4 size_of4(float4 v) { return v < 0.0f ? -v : v; }

inline float largest3(float4 v) { return MAX(v.x, MAX(v.y, v.z)); }

inline float lowest8(float8 v)
{
    const float4 a = v.lo < v.hi ? v.lo : v.hi;
    return MIN(MIN(a.x, a.y), MIN(a.z, a.w));
}

inline float lowest(float16 v) { return lowest8(v.lo < v.hi ? v.lo : v.hi); }

inline float highest8(float8 v) { return -lowest8(-v); }

inline float highest(float16 v) { return -lowest(-v); }

#ifdef CHUNKS
// First element of a chunk, where CHUNKS of them share a stream of n elements.
inline ulong chunk_first(ulong chunk, ulong n) { return chunk * n / CHUNKS; }

// Chunk of this work-item: first, and last + 1.
inline ulong chunk_begin(ulong n) { return chunk_first(get_global_id(0), n); }
inline ulong chunk_end(ulong n) { return chunk_first(get_global_id(0) + 1, n); }
#endif

// The box around `count` boxes, each a low and a high corner.
inline void join_boxes(global const float4 *boxes, uint count, float4 *low, float4 *high)
{
    *low = INFINITY;
    *high = -INFINITY;
    for (uint i = 0; i < count; i++) {
        const float4 a = boxes[2 * i], b = boxes[2 * i + 1];
        *low = a < *low ? a : *low;
        *high = b > *high ? b : *high;
    }
}
