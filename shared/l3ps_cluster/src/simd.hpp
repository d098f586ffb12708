// Sixteen lanes of float and unsigned, in the vector notation that GCC and Clang share.
//
// The compiler lowers them to whatever the target has: one AVX-512 register, two of AVX2, four of SSE2 or NEON. All
// give the same bits, because the build forbids contraction to fused multiply-add (-ffp-contract=off).
#pragma once

#include <cstdint>

#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace l3ps {

constexpr int LANES = 16;  // points a leaf of the tree, one cache line of each coordinate

typedef float f32x16 __attribute__((vector_size(64)));
typedef std::int32_t i32x16 __attribute__((vector_size(64)));
typedef std::uint32_t u32x16 __attribute__((vector_size(64)));
typedef float f32x4 __attribute__((vector_size(16)));

#define L3PS_INLINE inline __attribute__((always_inline))

L3PS_INLINE f32x16 load(const float* from) { return *reinterpret_cast<const f32x16*>(from); }
L3PS_INLINE u32x16 load(const std::uint32_t* from) { return *reinterpret_cast<const u32x16*>(from); }
L3PS_INLINE void store(float* to, f32x16 value) { *reinterpret_cast<f32x16*>(to) = value; }
L3PS_INLINE void store(std::uint32_t* to, u32x16 value) { *reinterpret_cast<u32x16*>(to) = value; }
L3PS_INLINE f32x16 all(float value) { return value - f32x16{}; }
L3PS_INLINE u32x16 all(std::uint32_t value) { return value - u32x16{}; }
L3PS_INLINE u32x16 lane_numbers() { return u32x16{0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15}; }

L3PS_INLINE f32x16 lesser(f32x16 a, f32x16 b) {
#if defined(__AVX512F__)
    return reinterpret_cast<f32x16>(_mm512_min_ps(reinterpret_cast<__m512>(a), reinterpret_cast<__m512>(b)));
#else
    return a < b ? a : b;
#endif
}

L3PS_INLINE f32x16 greater(f32x16 a, f32x16 b) {
#if defined(__AVX512F__)
    return reinterpret_cast<f32x16>(_mm512_max_ps(reinterpret_cast<__m512>(a), reinterpret_cast<__m512>(b)));
#else
    return a > b ? a : b;
#endif
}

// Bit i of the result is set where lane i of a comparison's result is.
L3PS_INLINE std::uint32_t bits(i32x16 mask) {
#if defined(__AVX512DQ__)
    return _mm512_movepi32_mask(reinterpret_cast<__m512i>(mask));
#elif defined(__AVX2__)
    union { i32x16 whole; __m256 half[2]; } split{mask};
    return static_cast<std::uint32_t>(_mm256_movemask_ps(split.half[0]) | (_mm256_movemask_ps(split.half[1]) << 8));
#elif defined(__SSE2__)
    union { i32x16 whole; __m128 part[4]; } split{mask};
    return static_cast<std::uint32_t>(_mm_movemask_ps(split.part[0]) | (_mm_movemask_ps(split.part[1]) << 4) |
                                      (_mm_movemask_ps(split.part[2]) << 8) | (_mm_movemask_ps(split.part[3]) << 12));
#else
    std::uint32_t out = 0;
    for (int i = 0; i < LANES; ++i) out |= (mask[i] ? 1u : 0u) << i;
    return out;
#endif
}

L3PS_INLINE bool any(i32x16 mask) { return bits(mask) != 0; }

L3PS_INLINE float largest(f32x16 value) {
#if defined(__AVX512F__)
    return _mm512_reduce_max_ps(reinterpret_cast<__m512>(value));
#else
    float out = value[0];
    for (int i = 1; i < LANES; ++i) out = value[i] > out ? value[i] : out;
    return out;
#endif
}

L3PS_INLINE float smallest(f32x16 value) { return -largest(-value); }

}  // namespace l3ps
