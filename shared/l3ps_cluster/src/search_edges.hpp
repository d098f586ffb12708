// The lightest edge that leaves each component: one round of Borůvka. Included by kernels.cpp alone.
#pragma once

#include "search.hpp"

namespace l3ps {
namespace L3PS_ISA {
namespace {

L3PS_INLINE float weight_now(const Edge& edge) {
    float weight;
    __atomic_load(&edge.weight, &weight, __ATOMIC_RELAXED);
    return weight;
}

// Keeps the lighter of the component's best edge and this one. The minimum of a total order does not depend on who
// comes first, so neither does the tree depend on the threads.
L3PS_INLINE void propose(const Forest& forest, std::uint32_t component, const Edge& edge) {
    Edge& best = forest.best[component];
    if (edge.weight > weight_now(best)) return;
    std::uint8_t* lock = forest.locks + component % LOCKS;
    while (__atomic_test_and_set(lock, __ATOMIC_ACQUIRE)) {
    }
    if (lighter(edge, best)) {
        __atomic_store(&best.weight, &edge.weight, __ATOMIC_RELAXED);
        best.distance = edge.distance, best.from = edge.from, best.to = edge.to;
    }
    __atomic_clear(lock, __ATOMIC_RELEASE);
}

L3PS_INLINE float distance_between(const TreeView& tree, std::uint32_t a, std::uint32_t b) {
    const float dx = tree.x[a] - tree.x[b], dy = tree.y[a] - tree.y[b], dz = tree.z[a] - tree.z[b];
    return (dx * dx + dy * dy) + dz * dz;
}

// What is known of a point without a search: the candidate of an earlier round, while it lies in another component, or
// the first of its nearest neighbours that does and is at least as dense, since no edge weighs less than the core
// distance.
L3PS_INLINE bool propose_point(const Forest& forest, std::uint32_t leaf, std::uint32_t lane) {
    const std::uint32_t point = leaf * LANES + lane, component = forest.component[point];
    const std::uint32_t candidate = forest.candidate[point];
    if (candidate != NONE) {
        if (forest.component[candidate] != component) {
            const float weight = forest.bound[point];
            if (weight <= weight_now(forest.best[component])) {
                propose(forest, component, {weight, distance_between(forest.tree, point, candidate), point, candidate});
            }
            return true;
        }
        forest.candidate[point] = NONE;
    }
    const float core = forest.core[point];
    Edge edge{INFINITE, INFINITE, point, NONE};
    for (int i = 0; i < forest.kept; ++i) {
        const std::uint32_t other = forest.near[(std::size_t(leaf) * forest.kept + i) * LANES + lane];
        if (other == NONE) break;
        if (forest.component[other] == component) continue;
        const float weight = forest.core[other] > core ? forest.core[other] : core;
        if (edge.to != NONE && weight >= edge.weight) continue;
        edge.weight = weight, edge.to = other;
        if (weight == core) {
            forest.candidate[point] = other;
            break;
        }
    }
    if (edge.to == NONE) return false;
    edge.distance = distance_between(forest.tree, point, edge.to);
    propose(forest, component, edge);
    return true;
}

void propose_known(const Forest& forest, std::uint32_t leaf, std::uint32_t end) {
    for (; leaf < end; ++leaf) {
        std::uint32_t open = forest.open[leaf];
        for (std::uint32_t left = open; left; left &= left - 1) {
            const std::uint32_t lane = static_cast<std::uint32_t>(__builtin_ctz(left));
            if (!propose_point(forest, leaf, lane)) open &= ~(1u << lane);
        }
        forest.open[leaf] = static_cast<std::uint16_t>(open);
    }
}

// The queries of one leaf, a lane each.
struct Front {
    Lanes at;
    Floats core;
    Uints component;
    Mask active;
    Floats weight, distance;  // of the lightest edge so far, or what an edge must not exceed; -1 in idle lanes
    Uints to;
};

L3PS_INLINE bool scan_edges(const Forest& forest, std::uint32_t leaf, Front& front) {
    Mask changed = none();
    const std::uint32_t begin = leaf * LANES;
    for (std::uint32_t i = 0; i < LANES; ++i) {
        const std::uint32_t at = begin + i;
        const Floats distance = squared_distance(front.at, forest.tree.x[at], forest.tree.y[at], forest.tree.z[at]);
        const Floats weight = greater(greater(distance, front.core), all(forest.core[at]));
        const Mask better = (front.component != all(forest.component[at])) &
                            ((weight < front.weight) | ((weight == front.weight) & (distance < front.distance)));
        front.weight = pick(better, weight, front.weight);
        front.distance = pick(better, distance, front.distance);
        front.to = pick(better, all(at), front.to);
        changed = changed | better;
    }
    return any(changed);
}

// Lanes that know no candidate and whose bound does not exceed the best edge of their component.
L3PS_INLINE bool gather(const Forest& forest, std::uint32_t leaf, std::uint32_t uniform, Front& front) {
    const std::uint32_t begin = leaf * LANES;
    const Floats bound = load(forest.bound + begin);
    const Mask real = lane_numbers() < all(forest.tree.count - begin);
    const Mask unknown = real & (load(forest.candidate + begin) == all(NONE));
    Floats limit;
    if (uniform != NONE) {
        limit = all(weight_now(forest.best[uniform]));
    } else {
        const std::uint32_t wanted = bits(unknown);
        alignas(64) float limits[LANES];
        for (std::uint32_t i = 0; i < LANES; ++i) {
            limits[i] = wanted >> i & 1 ? weight_now(forest.best[forest.component[begin + i]]) : -1.0f;
        }
        limit = load(limits);
    }
    front.active = unknown & (bound <= limit);
    if (!any(front.active)) return false;
    front.at = lanes_of(forest.tree, leaf);
    front.core = load(forest.core + begin);
    front.component = load(forest.component + begin);
    front.weight = pick(front.active, limit, all(-1.0f));
    front.distance = all(INFINITE);
    front.to = all(NONE);
    return true;
}

void search_leaf(const Forest& forest, std::uint32_t leaf) {
    const Node& own = forest.tree.nodes[forest.tree.leaf_node[leaf]];
    Front front;
    if (!gather(forest, leaf, own.component, front)) return;
    const std::uint32_t begin = leaf * LANES, active = bits(front.active);
    const std::uint32_t first = forest.component[begin + static_cast<std::uint32_t>(__builtin_ctz(active))];
    const bool one = !any(front.active & (front.component != all(first)));  // all queries of one component
    const float core = smallest(pick(front.active, front.core, all(INFINITE)));

    // Of queries of one component only the lightest edge counts; else each has one to find.
    float weight, distance;
    const auto tighten = [&] {
        if (one) {
            weight = smallest(pick(front.active, front.weight, all(INFINITE)));
            distance = smallest(pick(front.weight == all(weight), front.distance, all(INFINITE)));
        } else {
            weight = largest(front.weight);
            distance = largest(pick(front.weight == all(weight), front.distance, all(-1.0f)));
        }
    };
    tighten();
    descend(
        forest.tree, box_of(own),
        [&](const Node& node, float gap) {
            const float least = gap > core ? gap : core;
            return (one && node.component == first) || least > weight || (least == weight && gap >= distance);
        },
        [&](std::uint32_t other) {
            if (scan_edges(forest, other, front)) tighten();
        });

    // No edge that was left out is lighter than (weight, distance).
    const Mask lightest =
        (front.weight < all(weight)) | ((front.weight == all(weight)) & (front.distance <= all(distance)));
    const Mask known = front.active & (front.to != all(NONE)) & lightest;
    const Floats bound = lesser(front.weight, all(weight));
    store(forest.bound + begin, pick(front.active, bound, load(forest.bound + begin)));
    store(forest.candidate + begin, pick(known, front.to, load(forest.candidate + begin)));
    const std::uint32_t found = bits(known);
    forest.open[leaf] = static_cast<std::uint16_t>(forest.open[leaf] | found);
    for (std::uint32_t left = found; left; left &= left - 1) {
        const auto i = static_cast<std::uint32_t>(__builtin_ctz(left));
        propose(forest, lane(front.component, i),
                {lane(front.weight, i), lane(front.distance, i), begin + i, lane(front.to, i)});
    }
}

void search(const Forest& forest, std::uint32_t leaf, std::uint32_t end) {
    for (; leaf < end; ++leaf) search_leaf(forest, leaf);
}

}  // namespace
}  // namespace L3PS_ISA
}  // namespace l3ps
