// Vector operations that OpenCL C 1.2 cannot say well: a fused multiply-add that is not a call, and
// a comparison's result as a bit mask.
//
// PoCL's compiler knows the x86 built-ins; every other compiler, and PORTABLE, takes OpenCL C.
// PoCL compiles the built-in fma() to a call of its library, which costs brute force a factor of
// seven; both forms round once, so results are equal bit for bit.
//
//   FMA(a, b, c), FMA16(a, b, c)   a * b + c, rounded once
//   MASK16(m)                      bit i: lane i of a comparison's result (0 or -1)
//   COUNT16(mask)                  number of bits set
//   COMPRESS16(v, mask)            the lanes whose bit is set, moved to the front, the rest 0; defined
//                                  only where it is one instruction (AVX-512)
//
// Build-time constant: PORTABLE, where defined, keeps the x86 built-ins out.

#if defined(POCL_DEVICE_ADDRESS_BITS) && defined(__AVX2__) && defined(__FMA__) && !defined(PORTABLE)

#define FMA(a, b, c) __builtin_fmaf(a, b, c)
#define COUNT16(mask) ((uint)__builtin_popcount(mask))

#ifdef __AVX512DQ__
#define FMA16(a, b, c) __builtin_ia32_vfmaddps512_mask(a, b, c, (short)-1, 4)
#define MASK16(m) ((uint)(ushort)__builtin_ia32_cvtd2mask512(m))
#define COMPRESS16(v, mask)                                                                        \
    as_uint16(__builtin_ia32_compresssi512_mask(as_int16(v), (int16)0, (short)(mask)))
#else
inline float16 FMA16(float16 a, float16 b, float16 c)
{
    return (float16)(__builtin_ia32_vfmaddps256(a.lo, b.lo, c.lo),
                     __builtin_ia32_vfmaddps256(a.hi, b.hi, c.hi));
}
inline uint MASK16(int16 m)
{
    return (uint)__builtin_ia32_movmskps256(as_float8(m.lo))
           | ((uint)__builtin_ia32_movmskps256(as_float8(m.hi)) << 8);
}
#endif

#else

#define FMA(a, b, c) fma(a, b, c)
#define FMA16(a, b, c) fma(a, b, c)

inline uint MASK16(int16 m)
{
    const int16 bits = m
                       & (int16)(1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024, 2048, 4096, 8192,
                                 16384, 32768);
    const int8 a = bits.lo | bits.hi;
    const int4 b = a.lo | a.hi;
    return (uint)((b.x | b.y) | (b.z | b.w));
}

inline uint COUNT16(uint mask)
{
    mask = mask - ((mask >> 1) & 0x5555u);
    mask = (mask & 0x3333u) + ((mask >> 2) & 0x3333u);
    mask = (mask + (mask >> 4)) & 0x0f0fu;
    return (mask + (mask >> 8)) & 0x1fu;
}

#endif
