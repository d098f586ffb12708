// Descending the tree with a whole leaf of queries at once. Included by kernels.cpp alone.
#pragma once

#include "kernels.hpp"
#include "simd.hpp"

namespace l3ps {
namespace L3PS_ISA {

constexpr float INFINITE = __builtin_inff();

struct Box {
    f32x4 low, high;
};

L3PS_INLINE Box box_of(const Node& node) {
    return {*reinterpret_cast<const f32x4*>(node.low), *reinterpret_cast<const f32x4*>(node.high)};
}

// Squared distance of two boxes. Every step rounds like that of the points' distance, so it never exceeds the computed
// distance of any point in one to any point in the other.
L3PS_INLINE float apart(const Box& box, const Node& node) {
    const Box other = box_of(node);
    const f32x4 above = other.low - box.high, below = box.low - other.high;
    f32x4 gap = above > below ? above : below;  // lane 3 holds node fields and is not looked at
    gap = gap > 0.0f ? gap : f32x4{};
    gap = gap * gap;
    return (gap[0] + gap[1]) + gap[2];
}

struct Lanes {
    Floats x, y, z;
};

L3PS_INLINE Lanes lanes_of(const TreeView& tree, std::uint32_t leaf) {
    const std::uint32_t at = leaf * LANES;
    return {load(tree.x + at), load(tree.y + at), load(tree.z + at)};
}

L3PS_INLINE Floats squared_distance(const Lanes& lanes, float x, float y, float z) {
    const Floats dx = lanes.x - all(x), dy = lanes.y - all(y), dz = lanes.z - all(z);
    return (dx * dx + dy * dy) + dz * dz;
}

// Visits the leaves of the tree, nearer subtrees first. `pruned(node, distance)` says whether a node can be left out;
// `scan(leaf)` looks at a leaf's points.
template <typename Pruned, typename Scan>
L3PS_INLINE void descend(const TreeView& tree, const Box& box, Pruned&& pruned, Scan&& scan) {
    struct Waiting {
        std::uint32_t node;
        float distance;
    } stack[64];  // the tree is balanced, with at most 2^27 leaves
    int height = 0;
    Waiting at{0, apart(box, tree.nodes[0])};
    if (pruned(tree.nodes[0], at.distance)) return;
    for (;;) {
        const std::uint32_t child = tree.nodes[at.node].child;
        if (child & LEAF) {
            scan(child & ~LEAF);
        } else {
            const Node* pair = tree.nodes + child;
            float near = apart(box, pair[0]), far = apart(box, pair[1]);
            std::uint32_t near_node = child, far_node = child + 1;
            if (far < near) {
                const float distance = near;
                near = far, far = distance;
                near_node = child + 1, far_node = child;
            }
            if (!pruned(tree.nodes[far_node], far)) stack[height++] = {far_node, far};
            if (!pruned(tree.nodes[near_node], near)) {
                at = {near_node, near};
                continue;
            }
        }
        do {
            if (height == 0) return;
            at = stack[--height];
        } while (pruned(tree.nodes[at.node], at.distance));
    }
}

}  // namespace L3PS_ISA
}  // namespace l3ps
