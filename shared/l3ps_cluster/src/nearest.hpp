// Nearest neighbours of other points, and what noise makes of them.
#pragma once

#include "kdtree.hpp"

namespace l3ps {

// Squared distances and the caller's indices of each query's k nearest points within `limit` (squared), row after row
// in the caller's order of the queries; infinite and -1 where there are no more.
void nearest(const Tree& tree, const Tree& queries, int k, float limit, float* distance, std::int32_t* index,
             Team& team);

// Labels (by the caller's index, -1 for noise), where noise takes the most frequent label of its k nearest points that
// have one; of equally frequent ones the lowest. Distances count in float64, ties go to the lower index.
template <typename Real>
void fill_noise(const Real* points, std::size_t count, int dimensions, const std::int32_t* labels, int k,
                std::int32_t* filled, Team& team);

}  // namespace l3ps
