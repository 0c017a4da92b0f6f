// Places of cells along a Hilbert curve in space, sixteen at a time.

// A coordinate's bits to every third place.
inline uint16 spread_bits(uint16 v)
{
    v = (v | v << 16) & 0x030000ffu;
    v = (v | v << 8) & 0x0300f00fu;
    v = (v | v << 4) & 0x030c30c3u;
    return (v | v << 2) & 0x09249249u;
}

// Coordinates of `bits` bits, at most 10. Skilling 2004: the transpose, then its bits in turn.
inline uint16 hilbert_place(uint16 x, uint16 y, uint16 z, uint bits)
{
    for (uint bit = 1u << (bits - 1); bit > 1; bit >>= 1) {
        const uint below = bit - 1;
        x ^= (x & bit) != 0 ? (uint16)below : (uint16)0;
        const uint16 xy = (x ^ y) & below;
        const int16 invert_y = (y & bit) != 0;
        x ^= invert_y ? (uint16)below : xy;
        y ^= invert_y ? (uint16)0 : xy;
        const uint16 xz = (x ^ z) & below;
        const int16 invert_z = (z & bit) != 0;
        x ^= invert_z ? (uint16)below : xz;
        z ^= invert_z ? (uint16)0 : xz;
    }
    y ^= x;
    z ^= y;
    uint16 flips = 0;
    for (uint bit = 1u << (bits - 1); bit > 1; bit >>= 1)
        flips ^= (z & bit) != 0 ? (uint16)(bit - 1) : (uint16)0;
    return spread_bits(x ^ flips) << 2 | spread_bits(y ^ flips) << 1 | spread_bits(z ^ flips);
}
