// Sixteen lanes of float, unsigned or truth, made of as many registers as the target needs: two with AVX2, four with
// SSE2 or NEON. (One with AVX-512 was no faster than two.)
//
// Written in the vector notation that GCC and Clang share, but never wider than the target's registers: wider ones GCC
// takes apart lane by lane. All targets give the same bits, because the build forbids contraction to fused
// multiply-add (-ffp-contract=off).
#pragma once

#include "kdtree.hpp"

#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace l3ps {
namespace L3PS_ISA {

// L3PS_EACH_PART(statement) repeats the statement for every register i, spelled out: of a loop, GCC keeps the registers
// in memory.
#define L3PS_PART(I, ...)    \
    {                        \
        constexpr int i = I; \
        __VA_ARGS__;         \
    }
#if defined(__AVX2__)
#define L3PS_BYTES 32
#define L3PS_PARTS(...) L3PS_PART(0, __VA_ARGS__) L3PS_PART(1, __VA_ARGS__)
#else
#define L3PS_BYTES 16
#define L3PS_PARTS(...) \
    L3PS_PART(0, __VA_ARGS__) L3PS_PART(1, __VA_ARGS__) L3PS_PART(2, __VA_ARGS__) L3PS_PART(3, __VA_ARGS__)
#endif
#define L3PS_EACH_PART(...)     \
    do {                        \
        L3PS_PARTS(__VA_ARGS__) \
    } while (false)
constexpr int PARTS = 64 / L3PS_BYTES, WIDTH = L3PS_BYTES / 4;

template <typename T>
struct Lanes16 {
    typedef T Part __attribute__((vector_size(L3PS_BYTES), may_alias));
    Part part[PARTS];
};
using Floats = Lanes16<float>;
using Uints = Lanes16<std::uint32_t>;
using Mask = Lanes16<std::int32_t>;

#define L3PS_OPERATOR(RESULT, OPERAND, SIGN)                               \
    L3PS_INLINE RESULT operator SIGN(const OPERAND& a, const OPERAND& b) { \
        RESULT out;                                                        \
        L3PS_EACH_PART(out.part[i] = a.part[i] SIGN b.part[i]);            \
        return out;                                                        \
    }
L3PS_OPERATOR(Floats, Floats, +)
L3PS_OPERATOR(Floats, Floats, -)
L3PS_OPERATOR(Floats, Floats, *)
L3PS_OPERATOR(Mask, Floats, <)
L3PS_OPERATOR(Mask, Floats, <=)
L3PS_OPERATOR(Mask, Floats, ==)
L3PS_OPERATOR(Mask, Uints, <)
L3PS_OPERATOR(Mask, Uints, ==)
L3PS_OPERATOR(Mask, Uints, !=)
L3PS_OPERATOR(Mask, Mask, &)
L3PS_OPERATOR(Mask, Mask, |)
#undef L3PS_OPERATOR

L3PS_INLINE Floats all(float value) {
    Floats out;
    L3PS_EACH_PART(out.part[i] = value - Floats::Part{});
    return out;
}
L3PS_INLINE Uints all(std::uint32_t value) {
    Uints out;
    L3PS_EACH_PART(out.part[i] = value - Uints::Part{});
    return out;
}
L3PS_INLINE Mask none() { return Mask{}; }

// From and to cache lines.
template <typename T>
L3PS_INLINE Lanes16<T> load(const T* from) {
    Lanes16<T> out;
    L3PS_EACH_PART(out.part[i] = reinterpret_cast<const typename Lanes16<T>::Part*>(from)[i]);
    return out;
}
template <typename T>
L3PS_INLINE void store(T* to, const Lanes16<T>& value) {
    L3PS_EACH_PART(reinterpret_cast<typename Lanes16<T>::Part*>(to)[i] = value.part[i]);
}

L3PS_INLINE Uints lane_numbers() {
    alignas(64) static constexpr std::uint32_t NUMBERS[LANES] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    return load(NUMBERS);
}

// Lane by lane: a where the mask is set, else b.
template <typename T>
L3PS_INLINE Lanes16<T> pick(const Mask& mask, const Lanes16<T>& a, const Lanes16<T>& b) {
    Lanes16<T> out;
    L3PS_EACH_PART(out.part[i] = mask.part[i] ? a.part[i] : b.part[i]);
    return out;
}

// One register: the lesser and the greater of two lanes, and the sign bits of all lanes.
using FloatPart = Floats::Part;
using MaskPart = Mask::Part;
#if defined(__AVX2__)
L3PS_INLINE FloatPart part_min(FloatPart a, FloatPart b) { return FloatPart(_mm256_min_ps(__m256(a), __m256(b))); }
L3PS_INLINE FloatPart part_max(FloatPart a, FloatPart b) { return FloatPart(_mm256_max_ps(__m256(a), __m256(b))); }
L3PS_INLINE std::uint32_t part_bits(MaskPart mask) { return std::uint32_t(_mm256_movemask_ps(__m256(mask))); }
#elif defined(__SSE2__)
L3PS_INLINE FloatPart part_min(FloatPart a, FloatPart b) { return FloatPart(_mm_min_ps(__m128(a), __m128(b))); }
L3PS_INLINE FloatPart part_max(FloatPart a, FloatPart b) { return FloatPart(_mm_max_ps(__m128(a), __m128(b))); }
L3PS_INLINE std::uint32_t part_bits(MaskPart mask) { return std::uint32_t(_mm_movemask_ps(__m128(mask))); }
#else
L3PS_INLINE FloatPart part_min(FloatPart a, FloatPart b) { return a < b ? a : b; }
L3PS_INLINE FloatPart part_max(FloatPart a, FloatPart b) { return a > b ? a : b; }
L3PS_INLINE std::uint32_t part_bits(MaskPart mask) {
    std::uint32_t out = 0;
    for (int lane = 0; lane < WIDTH; ++lane) out |= (mask[lane] ? 1u : 0u) << lane;
    return out;
}
#endif

L3PS_INLINE Floats lesser(const Floats& a, const Floats& b) {
    Floats out;
    L3PS_EACH_PART(out.part[i] = part_min(a.part[i], b.part[i]));
    return out;
}
L3PS_INLINE Floats greater(const Floats& a, const Floats& b) {
    Floats out;
    L3PS_EACH_PART(out.part[i] = part_max(a.part[i], b.part[i]));
    return out;
}
// Bit i of the result is lane i of the mask.
L3PS_INLINE std::uint32_t bits(const Mask& mask) {
    std::uint32_t out = 0;
    L3PS_EACH_PART(out |= part_bits(mask.part[i]) << (i * WIDTH));
    return out;
}
L3PS_INLINE bool any(const Mask& mask) { return bits(mask) != 0; }

template <typename T>
L3PS_INLINE T lane(const Lanes16<T>& value, std::uint32_t at) {
    return value.part[at / WIDTH][at % WIDTH];
}

L3PS_INLINE float smallest(const Floats& value) {
    union {
        Floats whole;
        f32x4 quarter[4];
    } split{value};
    const f32x4 a = split.quarter[0] < split.quarter[1] ? split.quarter[0] : split.quarter[1];
    const f32x4 b = split.quarter[2] < split.quarter[3] ? split.quarter[2] : split.quarter[3];
    const f32x4 c = a < b ? a : b;
    const float low = c[0] < c[1] ? c[0] : c[1], high = c[2] < c[3] ? c[2] : c[3];
    return low < high ? low : high;
}
L3PS_INLINE float largest(const Floats& value) { return -smallest(all(0.0f) - value); }

}  // namespace L3PS_ISA
}  // namespace l3ps
