// From the spanning tree to clusters: condensed tree, excess of mass, labels.
#pragma once

#include <vector>

#include "kdtree.hpp"
#include "kernels.hpp"

namespace l3ps {

// Sorts by `lighter`, with `original` (place → caller's index) in place of the ends.
void sort_edges(Array<Edge>& edges, const Array<std::uint32_t>& original, const Team& team);

// Labels by the caller's index, -1 for noise; clusters are numbered in the order of their first points. `edges` sorted.
void label_points(const Array<Edge>& edges, const Tree& tree, std::uint32_t min_cluster_size, std::int32_t* labels,
                  const Team& team);

}  // namespace l3ps
