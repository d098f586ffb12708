// Core distances and the minimum spanning tree of mutual reachability.
#pragma once

#include "kdtree.hpp"
#include "kernels.hpp"

namespace l3ps {

// Squared distance of each place's point to its min_samples-th nearest other point, and the nearest `kept` of those.
struct Neighbourhood {
    int kept = 0;
    Array<float> core;          // [place], infinite after the last point
    Array<std::uint32_t> near;  // [leaf][kept][lane]
};

Neighbourhood neighbourhood(const Tree& tree, int min_samples, Team& team);

// count - 1 edges between places, in no particular but always the same order. Uses up the neighbourhood; leaves the
// components in the tree's nodes.
Array<Edge> spanning_tree(Tree& tree, Neighbourhood neighbourhood, Team& team);

}  // namespace l3ps
