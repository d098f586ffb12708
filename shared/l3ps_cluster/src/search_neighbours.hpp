// k nearest neighbours of every point. Included by kernels.cpp alone.
#pragma once

#include "search.hpp"

namespace l3ps {
namespace L3PS_ISA {
namespace {

// A lane a query: each point of a leaf is compared with sixteen queries at once, and sinks into the sorted lists of
// those it is near to without a branch. Equal distances keep the order in which they were met.
struct Lists {
    Floats* distance;
    Uints* index;

    L3PS_INLINE void insert(Floats found, Uints place, int k) const {
#pragma GCC unroll 16
        for (int i = k - 1; i > 0; --i) {
            const Mask before = found < distance[i - 1], here = found < distance[i];
            index[i] = pick(before, index[i - 1], pick(here, place, index[i]));
            distance[i] = lesser(distance[i], greater(distance[i - 1], found));
        }
        index[0] = pick(found < distance[0], place, index[0]);
        distance[0] = lesser(distance[0], found);
    }
};

template <bool OWN>
L3PS_INLINE bool scan(const TreeView& tree, std::uint32_t leaf, const Lanes& query, const Lists& lists, int k) {
    bool nearer = false;
    const std::uint32_t begin = leaf * LANES;
    for (std::uint32_t i = 0; i < LANES; ++i) {
        const std::uint32_t at = begin + i;
        Floats distance = squared_distance(query, tree.x[at], tree.y[at], tree.z[at]);
        if (OWN) distance = pick(lane_numbers() == all(i), all(INFINITE), distance);
        if (!any(distance < lists.distance[k - 1])) continue;
        lists.insert(distance, all(at), k);
        nearer = true;
    }
    return nearer;
}

L3PS_INLINE void neighbours_of_leaf(const NeighbourSearch& job, std::uint32_t leaf, const Lists& lists, int k) {
    const Lanes query = lanes_of(job.queries, leaf);
    const Mask real = lane_numbers() < all(job.queries.count - leaf * LANES);
    for (int i = 0; i < k; ++i) {
        lists.distance[i] = pick(real, all(job.limit), all(-1.0f));  // a place without a point finds and bounds nothing
        lists.index[i] = all(NONE);
    }
    float bound = job.limit;
    if (job.same) {
        scan<true>(job.tree, leaf, query, lists, k);
        bound = largest(lists.distance[k - 1]);
    }
    descend(
        job.tree, box_of(job.queries.nodes[job.queries.leaf_node[leaf]]),
        [&](const Node&, float distance) { return distance >= bound; },
        [&](std::uint32_t other) {
            if (job.same && other == leaf) return;
            if (scan<false>(job.tree, other, query, lists, k)) bound = largest(lists.distance[k - 1]);
        });
    const std::size_t row = leaf - job.first_written;
    for (int i = 0; i < job.kept; ++i) {
        const std::size_t to = (row * job.kept + i) * LANES;
        if (job.index) store(job.index + to, lists.index[i]);
        if (job.distance) store(job.distance + to, pick(lists.index[i] == all(NONE), all(INFINITE), lists.distance[i]));
    }
    if (job.last)
        store(job.last + row * LANES, pick(lists.index[k - 1] == all(NONE), all(INFINITE), lists.distance[k - 1]));
}

// With k known to the compiler the lists live in registers.
template <int K>
void neighbours_fixed(const NeighbourSearch& job, std::uint32_t leaf, std::uint32_t end) {
    for (; leaf < end; ++leaf) {
        Floats distance[K];
        Uints index[K];
        neighbours_of_leaf(job, leaf, {distance, index}, K);
    }
}

void neighbours(const NeighbourSearch& job, std::uint32_t leaf, std::uint32_t end, void* scratch) {
    switch (job.k) {
        case 1:
            return neighbours_fixed<1>(job, leaf, end);
        case 3:
            return neighbours_fixed<3>(job, leaf, end);
        case 4:
            return neighbours_fixed<4>(job, leaf, end);
        case 5:
            return neighbours_fixed<5>(job, leaf, end);
        case 10:
            return neighbours_fixed<10>(job, leaf, end);
        default:
            break;
    }
    const Lists lists{static_cast<Floats*>(scratch), static_cast<Uints*>(scratch) + job.k};
    for (; leaf < end; ++leaf) neighbours_of_leaf(job, leaf, lists, job.k);
}

}  // namespace
}  // namespace L3PS_ISA
}  // namespace l3ps
