// A balanced kd-tree whose leaves are sixteen points: one cache line of x, one of y, one of z.
//
// Points lie in tree order. Every leaf but the last is full, because a node of m leaves gives its left child
// ceil(m / 2) of them; so leaf i holds the points 16 i … 16 i + 15 and no node needs a range. The places after the last
// point hold FAR, which is no neighbour of anything.
#pragma once

#include <cstdint>

#include "memory.hpp"
#include "parallel.hpp"

namespace l3ps {

constexpr int LANES = 16;  // points a leaf
constexpr std::uint32_t NONE = 0xFFFFFFFFu;
constexpr std::uint32_t LEAF = 0x80000000u;
constexpr float FAR = 1e30f;  // its square is infinite

#define L3PS_INLINE inline __attribute__((always_inline))

typedef float f32x4 __attribute__((vector_size(16), may_alias));  // every processor has these

// Siblings share a cache line; a search that looks at one looks at both.
struct alignas(32) Node {
    float low[3];
    std::uint32_t component;  // of all points below, NONE where they differ (the spanning tree's rounds set it)
    float high[3];
    std::uint32_t child;  // left child, the right one follows; LEAF | number for a leaf
};

struct Tree {
    std::uint32_t count = 0;   // points
    std::uint32_t leaves = 0;  // and 16 × leaves places
    double scale = 1.0;        // power of two that distances are multiplied by to be in the caller's unit
    Array<float> x, y, z;
    Array<std::uint32_t> original;  // place → the caller's index
    Array<Node> nodes;              // root at 0, children in pairs from 2 on, parents before children
    Array<std::uint32_t> leaf_node;

    std::uint32_t places() const { return leaves * LANES; }
};

// Where the caller's coordinates go before they become float32.
struct Frame {
    double centre[3] = {0, 0, 0};
    int exponent = 0;  // coordinates are multiplied by two to this
};

// The frame for points of `dimensions` 2 or 3, row after row. Float64 is brought near the origin, so that UTM
// coordinates keep their digits; float32 is taken as it is, since differences of neighbours are exact then. Throws
// std::invalid_argument for coordinates that are not finite.
template <typename Real>
Frame frame_of(const Real* points, std::size_t count, int dimensions, Team& team);

template <typename Real>
Tree build_tree(const Real* points, std::size_t count, int dimensions, const Frame& frame, Team& team);

}  // namespace l3ps
