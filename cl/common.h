// Shared by every file of cl/: rounding rules, constants, small vector helpers.
//
// Contraction is off, so that a*b+c rounds twice here as in numpy; where one rounding is wanted,
// fma() says so. The built-in min, max, fabs, clamp are not used in hot code: PoCL calls them out of
// line (ten times slower than ?:).

#pragma OPENCL FP_CONTRACT OFF

#include "simd.h"

#define INVALID 0xffffffffu

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

inline float lowest(float16 v)
{
    const float8 a = v.lo < v.hi ? v.lo : v.hi;
    const float4 b = a.lo < a.hi ? a.lo : a.hi;
    return MIN(MIN(b.x, b.y), MIN(b.z, b.w));
}

#ifdef CHUNKS
// First element of a chunk, where CHUNKS of them share a stream of n elements.
inline ulong chunk_first(ulong chunk, ulong n) { return chunk * n / CHUNKS; }

// Chunk of this work-item: first, and last + 1.
inline ulong chunk_begin(ulong n) { return chunk_first(get_global_id(0), n); }
inline ulong chunk_end(ulong n) { return chunk_first(get_global_id(0) + 1, n); }
#endif
