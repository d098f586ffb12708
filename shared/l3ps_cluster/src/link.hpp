// Single linkage cut at a distance.
#pragma once

#include "kdtree.hpp"

namespace l3ps {

// Components of the points of which none is farther than `gap` (in the tree's unit) from the next, by the caller's
// index, numbered in the order of their first points.
void link(const Tree& tree, double gap, std::int32_t* labels, Team& team);

}  // namespace l3ps
