// The loops that take the time, compiled once for each instruction set and chosen when first used.
//
// kernels.cpp is built several times with L3PS_ISA naming the copy; it keeps clear of the standard library's templates,
// so that no copy of one of those, built for a newer processor, can be linked into code that runs everywhere.
#pragma once

#include <cstdint>

#include "kdtree.hpp"

namespace l3ps {

// What the searches need of a tree, as plain pointers.
struct TreeView {
    const float *x, *y, *z;
    const Node* nodes;
    const std::uint32_t* leaf_node;
    std::uint32_t count, leaves;
};

inline TreeView view(const Tree& tree) {
    return {tree.x.data(),         tree.y.data(), tree.z.data(), tree.nodes.data(),
            tree.leaf_node.data(), tree.count,    tree.leaves};
}

// Nearest neighbours of the points of `queries` among those of `tree`; both may be one tree.
struct NeighbourSearch {
    TreeView tree, queries;
    bool same;                    // queries are the tree's own points: none is its own neighbour
    int k;                        // neighbours looked for
    int kept;                     // of which the indices are written
    std::uint32_t first_written;  // leaf at which the arrays below begin
    float limit;                  // squared distance from which on a point is no neighbour
    float* distance;              // out: squared, [leaf][kept][lane], may be null
    float* last;           // out: squared distance of the k-th, [place], infinite where there is none; may be null
    std::uint32_t* index;  // out: places, [leaf][kept][lane], NONE where there is none; may be null
};

// The lightest edge found so far that leaves a component. Edges are compared by weight, then by distance, then by
// their ends: the many edges of one point that weigh its core distance then have an order of their own, which no
// numbering of the points decides.
struct Edge {
    float weight;    // squared mutual reachability distance
    float distance;  // squared
    std::uint32_t from, to;
};

L3PS_INLINE bool lighter(const Edge& a, const Edge& b) {
    if (a.weight != b.weight) return a.weight < b.weight;
    if (a.distance != b.distance) return a.distance < b.distance;
    const std::uint32_t a_low = a.from < a.to ? a.from : a.to, b_low = b.from < b.to ? b.from : b.to;
    if (a_low != b_low) return a_low < b_low;
    return (a.from ^ a.to ^ a_low) < (b.from ^ b.to ^ b_low);
}

constexpr int LOCKS = 4096;

// State of the spanning tree between rounds; arrays by place unless they say otherwise.
struct Forest {
    TreeView tree;
    const float* core;          // squared core distance
    const std::uint32_t* near;  // [leaf][kept][lane] nearest neighbours
    int kept;
    const std::uint32_t* component;  // number of the component: a place in it
    float* bound;                    // every edge of the point to another component weighs at least this
    std::uint32_t* candidate;        // the other end of its lightest such edge, NONE where unknown
    std::uint16_t* open;             // [leaf] lanes some of whose nearest neighbours lie in other components
    Edge* best;                      // [component]
    std::uint8_t* locks;             // [LOCKS]
};

struct Kernels {
    const char* name;
    // `scratch`: 128 k bytes on a cache-line border.
    void (*neighbours)(const NeighbourSearch&, std::uint32_t first_leaf, std::uint32_t end_leaf, void* scratch);
    void (*propose_known)(const Forest&, std::uint32_t first_leaf, std::uint32_t end_leaf);
    void (*search)(const Forest&, std::uint32_t first_leaf, std::uint32_t end_leaf);
};

// The best copy that this processor runs, or the one chosen by name, so that tests can try them all.
const Kernels& kernels();
bool choose_kernels(const char* name);

}  // namespace l3ps
