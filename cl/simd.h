// Vector operations that OpenCL C 1.2 cannot say well: a fused multiply-add that is not a call, and
// a comparison's result as a bit mask.
//
// PoCL's compiler knows the x86 built-ins; every other compiler, and PORTABLE, takes OpenCL C.
// PoCL compiles the built-in fma() to a call of its library, which costs brute force a factor of
// seven; both forms round once, so results are equal bit for bit.
//
//   FMA(a, b, c), FMA8, FMA16      a * b + c, rounded once
//   FMA4(a, b, c), MASK4(m)        the same for float4 and int4
//   SQRT16(v)                      square roots, correctly rounded
//   MASK8(m), MASK16(m)            bit i: lane i of a comparison's result (0 or -1)
//   COUNT16(mask), COUNT64(mask)   number of bits set
//   LOWEST(mask)                   number of the lowest bit set, of a mask that is not 0
//   COMPRESS16(v, mask)            the lanes whose bit is set, moved to the front, the rest 0
//   COMPRESS_BYTES4, 8, 16(v, mask)  the same for elements of so many bytes, a bit each
//   STORE_MASKED(p, v, mask)       lanes whose bit is set to p[lane], the others are left alone
//                                  (all of these are defined only where there is AVX-512)
//
//   NONZERO64(p)                   bit i: whether byte i of the 64 at p is not 0
//   TEST64(p, bit)                 bit i: whether byte i of the 64 at p has that bit set
//   EVEN_LANES(a, b), ODD_LANES    a0 a2 .. ae b0 b2 .. be, and a1 a3 .. af b1 b3 .. bf
//   LOW_PAIRS(a, b), HIGH_PAIRS    a0 b0 a1 b1 .. a7 b7, and a8 b8 .. af bf
//   TRANSPOSE16(s, x, y, z, w)     sixteen float4 s[] as four float16 rows
//   CONVERT(T, v)                  lane by lane, as a cast
//   LOAD_UNALIGNED(T, p), STORE_UNALIGNED(T, p, v)   T a vector of sixteen
//   STORE_UNALIGNED_QUAD(p, v)     v an uint4
//   LOAD_PRIVATE(T, p), STORE_PRIVATE(T, p, v)         the same in private memory
//   PREFETCH(p), PREFETCH_PRIVATE(p)  the line at p will be read, in global or private memory
//   STORE_STREAMING(T, p, v)       to global memory aligned to T, past the caches
//
// Build-time constant: PORTABLE, where defined, keeps the x86 built-ins out.

#if defined(POCL_DEVICE_ADDRESS_BITS) && defined(__AVX2__) && defined(__FMA__) && !defined(PORTABLE)

#define X86_BUILTINS
#define FMA(a, b, c) __builtin_fmaf(a, b, c)
#define FMA4(a, b, c) __builtin_ia32_vfmaddps(a, b, c)
#define MASK4(m) ((uint)__builtin_ia32_movmskps(as_float4(m)))
#define FMA8(a, b, c) __builtin_ia32_vfmaddps256(a, b, c)
#define MASK8(m) ((uint)__builtin_ia32_movmskps256(as_float8(m)))
#define COUNT16(mask) ((uint)__builtin_popcount(mask))
#define COUNT64(mask) ((uint)__builtin_popcountl(mask))
#define LOWEST(mask) ((uint)__builtin_ctz(mask))

#ifdef __AVX512DQ__
#define FMA16(a, b, c) __builtin_ia32_vfmaddps512_mask(a, b, c, (short)-1, 4)
#define SQRT16(v) __builtin_ia32_sqrtps512(v, 4)
#define MASK16(m) ((uint)(ushort)__builtin_ia32_cvtd2mask512(m))
#define COMPRESS16(v, mask)                                                                        \
    as_uint16(__builtin_ia32_compresssi512_mask(as_int16(v), (int16)0, (short)(mask)))
#define STORE_MASKED(p, v, mask)                                                                   \
    __builtin_ia32_storedqusi512_mask((int *)(ulong)(p), as_int16(v), (short)(mask))
typedef char Bytes64 __attribute__((vector_size(64)));
inline ulong TEST64(global const uchar *p, uint bit)
{
    typedef Bytes64 Unaligned __attribute__((aligned(1)));
    const char b = (char)(1 << bit);
    const Bytes64 bits = {b, b, b, b, b, b, b, b, b, b, b, b, b, b, b, b, b, b, b, b, b, b,
                          b, b, b, b, b, b, b, b, b, b, b, b, b, b, b, b, b, b, b, b, b, b,
                          b, b, b, b, b, b, b, b, b, b, b, b, b, b, b, b, b, b, b, b};
    return __builtin_ia32_cvtb2mask512(*(global const Unaligned *)p << (7 - bit));
}
inline ulong NONZERO64(global const uchar *p)
{
    typedef Bytes64 Unaligned __attribute__((aligned(1)));
    const Bytes64 bytes = *(global const Unaligned *)p;
    return __builtin_ia32_cmpb512_mask(bytes, bytes ^ bytes, 4, ~0ul);
}

#define COMPRESS_BYTES4(v, mask) COMPRESS16(v, mask)
#define COMPRESS_BYTES8(v, mask)                                                                   \
    as_uint16(__builtin_ia32_compressdi512_mask(as_long8(v), (long8)0, (char)(mask)))
#define COMPRESS_BYTES16(v, mask) COMPRESS_BYTES8(v, DOUBLED[mask])
constant uchar DOUBLED[16] = {0x00, 0x03, 0x0c, 0x0f, 0x30, 0x33, 0x3c, 0x3f,
                              0xc0, 0xc3, 0xcc, 0xcf, 0xf0, 0xf3, 0xfc, 0xff};
#define HAS_TEST64
#else
inline float16 FMA16(float16 a, float16 b, float16 c)
{
    return (float16)(__builtin_ia32_vfmaddps256(a.lo, b.lo, c.lo),
                     __builtin_ia32_vfmaddps256(a.hi, b.hi, c.hi));
}
#define SQRT16(v)                                                                                  \
    (float16)(__builtin_ia32_sqrtps256((v).lo), __builtin_ia32_sqrtps256((v).hi))
inline uint MASK16(int16 m)
{
    return (uint)__builtin_ia32_movmskps256(as_float8(m.lo))
           | ((uint)__builtin_ia32_movmskps256(as_float8(m.hi)) << 8);
}
#endif

#else

#define FMA(a, b, c) fma(a, b, c)
#define FMA4(a, b, c) fma(a, b, c)
#define FMA8(a, b, c) fma(a, b, c)
#define FMA16(a, b, c) fma(a, b, c)
#define SQRT16(v) sqrt(v)

inline uint MASK16(int16 m)
{
    const int16 bits = m
                       & (int16)(1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024, 2048, 4096, 8192,
                                 16384, 32768);
    const int8 a = bits.lo | bits.hi;
    const int4 b = a.lo | a.hi;
    return (uint)((b.x | b.y) | (b.z | b.w));
}

inline uint MASK4(int4 m)
{
    const int4 bits = m & (int4)(1, 2, 4, 8);
    return (uint)((bits.x | bits.y) | (bits.z | bits.w));
}

inline uint MASK8(int8 m)
{
    const int8 bits = m & (int8)(1, 2, 4, 8, 16, 32, 64, 128);
    const int4 a = bits.lo | bits.hi;
    return (uint)((a.x | a.y) | (a.z | a.w));
}

#define COUNT16(mask) popcount((uint)(mask))
#define COUNT64(mask) ((uint)popcount((ulong)(mask)))
#define LOWEST(mask) (31 - clz((mask) & -(mask)))

#endif

#define EVEN_LANES(a, b) (uint16)((a).even, (b).even)
#define ODD_LANES(a, b) (uint16)((a).odd, (b).odd)

#ifndef HAS_TEST64
inline ulong NONZERO64(global const uchar *p)
{
    ulong mask = 0;
    for (uint k = 0; k < 64; k++)
        mask |= (ulong)(p[k] != 0) << k;
    return mask;
}

inline ulong TEST64(global const uchar *p, uint bit)
{
    ulong mask = 0;
    for (uint k = 0; k < 8; k++) {
        const ulong bytes = (as_ulong(vload8(k, p)) >> bit) & 0x0101010101010101ul;
        // The product gathers the lowest bits of eight bytes in its top byte.
        mask |= ((bytes * 0x0102040810204080ul) >> 56) << (8 * k);
    }
    return mask;
}
#endif

#ifdef X86_BUILTINS

#define CONVERT(T, v) __builtin_convertvector(v, T)
#define STORE_STREAMING(T, p, v) __builtin_nontemporal_store(v, (global T *)(p))
#define PREFETCH(p) __builtin_prefetch((const void *)(ulong)(p))
#define PREFETCH_PRIVATE(p) PREFETCH(p)
#define LOW_PAIRS(a, b)                                                                            \
    __builtin_shufflevector(a, b, 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23)
#define HIGH_PAIRS(a, b)                                                                           \
    __builtin_shufflevector(a, b, 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31)
#define LOAD_UNALIGNED(T, p)                                                                       \
    (((global const struct __attribute__((packed, aligned(1))) { T value; } *)(p))->value)
#define STORE_UNALIGNED(T, p, v)                                                                   \
    (((global struct __attribute__((packed, aligned(1))) { T value; } *)(p))->value = (v))

#define STORE_UNALIGNED_QUAD(p, v) STORE_UNALIGNED(uint4, p, v)
#define LOAD_PRIVATE(T, p)                                                                         \
    (((const struct __attribute__((packed, aligned(1))) { T value; } *)(p))->value)
#define STORE_PRIVATE(T, p, v)                                                                     \
    (((struct __attribute__((packed, aligned(1))) { T value; } *)(p))->value = (v))

// Within each 128-bit lane, four rows of four become four columns.
#define LOW_QUADS(a, b)                                                                            \
    __builtin_shufflevector(a, b, 0, 16, 1, 17, 4, 20, 5, 21, 8, 24, 9, 25, 12, 28, 13, 29)
#define HIGH_QUADS(a, b)                                                                           \
    __builtin_shufflevector(a, b, 2, 18, 3, 19, 6, 22, 7, 23, 10, 26, 11, 27, 14, 30, 15, 31)
#define FIRST_HALVES(a, b)                                                                         \
    __builtin_shufflevector(a, b, 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29)
#define SECOND_HALVES(a, b)                                                                        \
    __builtin_shufflevector(a, b, 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31)
#define TRANSPOSE16(s, x, y, z, w)                                                                 \
    {                                                                                              \
        const float16 r0 = (float16)(s[0], s[4], s[8], s[12]);                                     \
        const float16 r1 = (float16)(s[1], s[5], s[9], s[13]);                                     \
        const float16 r2 = (float16)(s[2], s[6], s[10], s[14]);                                    \
        const float16 r3 = (float16)(s[3], s[7], s[11], s[15]);                                    \
        const float16 lo01 = LOW_QUADS(r0, r1), hi01 = HIGH_QUADS(r0, r1);                         \
        const float16 lo23 = LOW_QUADS(r2, r3), hi23 = HIGH_QUADS(r2, r3);                         \
        x = FIRST_HALVES(lo01, lo23);                                                              \
        y = SECOND_HALVES(lo01, lo23);                                                             \
        z = FIRST_HALVES(hi01, hi23);                                                              \
        w = SECOND_HALVES(hi01, hi23);                                                             \
    }

#else

#define CONVERT(T, v) CONVERT_(T, v)
#define STORE_STREAMING(T, p, v) (*(global T *)(p) = (v))
#define PREFETCH(p) prefetch(p, 1)
#define PREFETCH_PRIVATE(p) // OpenCL C has none
#define CONVERT_(T, v) convert_##T(v)
#define LOAD_UNALIGNED(T, p) vload16(0, p)
#define LOAD_PRIVATE(T, p) vload16(0, p)
#define STORE_PRIVATE(T, p, v) vstore16(v, 0, p)
#define STORE_UNALIGNED(T, p, v) vstore16(v, 0, p)
#define STORE_UNALIGNED_QUAD(p, v) vstore4(v, 0, p)

#define TRANSPOSE16(s, to_x, to_y, to_z, to_w)                                                     \
    {                                                                                              \
        float lane[4][16] __attribute__((aligned(64)));                                            \
        for (uint k = 0; k < 16; k++)                                                              \
            lane[0][k] = s[k].x, lane[1][k] = s[k].y, lane[2][k] = s[k].z, lane[3][k] = s[k].w;    \
        to_x = *(float16 *)lane[0];                                                                \
        to_y = *(float16 *)lane[1];                                                                \
        to_z = *(float16 *)lane[2];                                                                \
        to_w = *(float16 *)lane[3];                                                                \
    }

#endif
