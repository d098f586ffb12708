#include "hierarchy.hpp"

#include <cmath>
#include <cstring>
#include <limits>

namespace l3ps {
namespace {

// A cluster of the condensed tree. The `hdbscan` package builds that tree from the root down; the same clusters come
// out of the merges from the lightest up, in one pass and without the dendrogram: a component that reaches the minimum
// size is a cluster, which lasts until it meets another one; both are then children of a new cluster.
struct Cluster {
    double birth = 0;  // lambda at which it splits from its sibling; the root's is 0
    double death = 0;  // lambda at which it splits in two, where it does
    double stability = 0;
    std::uint32_t sizes[2] = {0, 0};  // of its children
    std::uint32_t children[2] = {NONE, NONE};
    std::uint32_t parent = NONE;
    bool selected = false;
};

// A component of the merges so far; one entry a place, meaningful for the component's representative.
struct Component {
    std::uint32_t parent;  // towards the representative
    std::uint32_t size;
    std::uint32_t next;  // ring of the points of a component that is smaller than a cluster
    std::uint32_t cluster;
};

// Where a point leaves the tree: the smallest cluster around it, and the weight of the edge that ties it to that.
struct Fall {
    std::uint32_t cluster;
    float weight;
};

class Condenser {
public:
    Condenser(const Tree& tree, std::uint32_t min_cluster_size)
        : tree_(tree), least_(min_cluster_size), components_(tree.count), falls_(tree.count, {NONE, 0}) {
        for (std::uint32_t i = 0; i < tree.count; ++i) components_[i] = {i, 1, i, NONE};
    }

    void condense(const Array<Edge>& edges, const Team& team) {
        std::size_t i = 0;
        for (; i < edges.size() && edges[i].weight == 0; ++i) coincide(edges[i]);
        settle();
        for (; i < edges.size(); ++i) {
            if (i % 65536 == 0) team.check();
            merge(edges[i]);
        }
    }

    // Excess of mass, from the leaves of the condensed tree up; its root is never a cluster. As in the package, sums of
    // stabilities are kept in single precision.
    void select() {
        weigh();
        if (clusters_.empty()) return;
        clusters_.pop_back();  // the root came last
        for (Cluster& cluster : clusters_) {
            float below = 0;
            for (const std::uint32_t child : cluster.children) {
                if (child != NONE) below = static_cast<float>(below + clusters_[child].stability);
            }
            cluster.selected = !(below > cluster.stability);
            if (!cluster.selected) cluster.stability = below;
        }
    }

    void label(std::int32_t* labels) const {
        // The topmost selected cluster among each one and those around it; parents come after their children.
        std::vector<std::int32_t> topmost(clusters_.size() + 1, -1);  // the last is the root
        for (std::size_t i = clusters_.size(); i-- > 0;) {
            topmost[i] = topmost[clusters_[i].parent];
            if (topmost[i] < 0 && clusters_[i].selected) topmost[i] = static_cast<std::int32_t>(i);
        }
        for (std::uint32_t i = 0; i < tree_.count; ++i) {
            const std::uint32_t cluster = falls_[i].cluster;
            labels[tree_.original[i]] = cluster == NONE ? -1 : topmost[cluster];
        }
        std::vector<std::int32_t> number(clusters_.size(), -1);
        std::int32_t used = 0;
        for (std::uint32_t i = 0; i < tree_.count; ++i) {
            if (labels[i] < 0) continue;
            std::int32_t& own = number[static_cast<std::size_t>(labels[i])];
            if (own < 0) own = used++;
            labels[i] = own;
        }
    }

private:
    // Points with as many others at distance 0 as count for density: they merge all at once, not in an order that
    // could split them into clusters of no extent.
    void coincide(const Edge& edge) {
        const std::uint32_t a = root(edge.from), b = root(edge.to);
        std::swap(components_[a].next, components_[b].next);  // two rings become one
        components_[b].parent = a;
        components_[a].size += components_[b].size;
    }

    void settle() {
        for (std::uint32_t i = 0; i < tree_.count; ++i) {
            if (components_[i].parent != i || components_[i].size < least_) continue;
            components_[i].cluster = static_cast<std::uint32_t>(clusters_.size());
            clusters_.emplace_back();
            fall(i, components_[i].cluster, 0);
        }
    }

    void merge(const Edge& edge) {
        std::uint32_t a = root(edge.from), b = root(edge.to);
        if (components_[a].size < components_[b].size) std::swap(a, b);
        Component &large = components_[a], &small = components_[b];
        if (small.size >= least_) {
            join(large, small, lambda(edge.weight));
        } else if (large.size >= least_) {
            fall(b, large.cluster, edge.weight);
        } else if (large.size + small.size >= least_) {
            large.cluster = static_cast<std::uint32_t>(clusters_.size());
            clusters_.emplace_back();
            fall(a, large.cluster, edge.weight);
            fall(b, large.cluster, edge.weight);
        } else {
            std::swap(large.next, small.next);  // two rings become one
        }
        small.parent = a;
        large.size += small.size;
    }

    double lambda(float weight) const {
        return weight > 0 ? 1 / (std::sqrt(double(weight)) * tree_.scale) : std::numeric_limits<double>::infinity();
    }

    std::uint32_t root(std::uint32_t of) {
        while (components_[of].parent != of) {
            of = components_[of].parent = components_[components_[of].parent].parent;
        }
        return of;
    }

    void join(Component& large, const Component& small, double at) {
        const auto both = static_cast<std::uint32_t>(clusters_.size());
        clusters_.emplace_back();
        clusters_[both].death = at;
        const Component* parts[2] = {&large, &small};
        for (int i = 0; i < 2; ++i) {
            clusters_[both].children[i] = parts[i]->cluster;
            clusters_[both].sizes[i] = parts[i]->size;
            clusters_[parts[i]->cluster].parent = both;
            clusters_[parts[i]->cluster].birth = at;
        }
        large.cluster = both;
    }

    void fall(std::uint32_t first, std::uint32_t cluster, float weight) {
        std::uint32_t at = first;
        do {
            falls_[at] = {cluster, weight};
            at = components_[at].next;
        } while (at != first);
    }

    void weigh() {
        for (const Fall& fall : falls_) {
            if (fall.cluster == NONE) continue;
            Cluster& cluster = clusters_[fall.cluster];
            cluster.stability += lambda(fall.weight) - cluster.birth;
        }
        for (Cluster& cluster : clusters_) {
            if (cluster.children[0] == NONE) continue;
            for (const std::uint32_t size : cluster.sizes) cluster.stability += (cluster.death - cluster.birth) * size;
        }
    }

    const Tree& tree_;
    std::uint32_t least_;
    Array<Component> components_;
    Array<Fall> falls_;
    std::vector<Cluster> clusters_;
};

struct Key {
    std::uint32_t weight, edge;
};

}  // namespace

void sort_edges(Array<Edge>& edges, const Array<std::uint32_t>& original, const Team& team) {
    // Floats that are not negative sort like their bits: three passes of eleven bits.
    Array<Key> keys(edges.size()), other(edges.size());
    for (std::size_t i = 0; i < edges.size(); ++i) {
        std::memcpy(&keys[i].weight, &edges[i].weight, sizeof(float));
        keys[i].edge = static_cast<std::uint32_t>(i);
    }
    for (int shift = 0; shift < 33; shift += 11) {
        team.check();
        std::vector<std::size_t> start(2048 + 1);
        for (const Key& key : keys) ++start[(key.weight >> shift & 2047) + 1];
        for (int i = 0; i < 2048; ++i) start[i + 1] += start[i];
        for (const Key& key : keys) other[start[key.weight >> shift & 2047]++] = key;
        keys.swap(other);
    }
    other.release();
    Array<Edge> sorted(edges.size());
    for (std::size_t i = 0; i < edges.size(); ++i) sorted[i] = edges[keys[i].edge];
    keys.release();
    const auto less = [&](Edge a, Edge b) {
        a.from = original[a.from], a.to = original[a.to], b.from = original[b.from], b.to = original[b.to];
        return lighter(a, b);
    };
    for (std::size_t begin = 0, end; begin < sorted.size(); begin = end) {
        for (end = begin + 1; end < sorted.size() && sorted[end].weight == sorted[begin].weight;) ++end;
        if (end - begin > 1) std::sort(sorted.begin() + begin, sorted.begin() + end, less);
    }
    edges.swap(sorted);
}

void label_points(const Array<Edge>& edges, const Tree& tree, std::uint32_t min_cluster_size, std::int32_t* labels,
                  const Team& team) {
    Condenser condenser(tree, min_cluster_size);
    condenser.condense(edges, team);
    condenser.select();
    condenser.label(labels);
}

}  // namespace l3ps
