#include "spanning_tree.hpp"

#include <cstring>
#include <limits>
#include <stdexcept>
#include <vector>

namespace l3ps {
namespace {

constexpr float INFINITE = std::numeric_limits<float>::infinity();
// More neighbours than these save no searches worth their memory.
constexpr int MOST_KEPT = 8;
// Leaves a thread takes at a time: 0.1 ms of work, and a stop is noticed between two.
constexpr std::size_t CHUNK = 64;

std::uint32_t root_of(Array<std::uint32_t>& parent, std::uint32_t of) {
    while (parent[of] != of) of = parent[of] = parent[parent[of]];
    return of;
}

class Boruvka {
public:
    Boruvka(Tree& tree, Neighbourhood& around, Team& team)
        : tree_(tree),
          around_(around),
          team_(team),
          component_(tree.places()),
          parent_(tree.places()),
          bound_(tree.places()),
          candidate_(tree.places(), NONE),
          open_(tree.leaves, 0xFFFF),
          best_(tree.count),
          locks_(LOCKS, 0),
          edges_(tree.count - 1),
          roots_(tree.count) {
        for (std::uint32_t i = 0; i < tree.places(); ++i) component_[i] = parent_[i] = i;
        for (std::uint32_t i = 0; i < tree.count; ++i) roots_[i] = i;
        std::memcpy(bound_.data(), around.core.data(), tree.places() * sizeof(float));
        const std::uint32_t padding = tree.places() - tree.count;
        open_[tree.leaves - 1] = static_cast<std::uint16_t>(0xFFFFu >> padding);
    }

    Array<Edge> run() {
        while (made_ + 1 < tree_.count) round();
        return std::move(edges_);
    }

private:
    void round() {
        const Forest forest{view(tree_),   around_.core.data(), around_.near.data(), around_.kept, component_.data(),
                            bound_.data(), candidate_.data(),   open_.data(),        best_.data(), locks_.data()};
        for (const std::uint32_t root : roots_) best_[root] = {INFINITE, INFINITE, NONE, NONE};
        const Kernels& kernel = kernels();
        team_.over(tree_.leaves, CHUNK, [&](std::size_t a, std::size_t b) { kernel.propose_known(forest, a, b); });
        team_.over(tree_.leaves, CHUNK, [&](std::size_t a, std::size_t b) { kernel.search(forest, a, b); });
        merge();
        relabel();
    }

    // Where edges tie in weight and distance, the choices of three or more components may close a circle; its last edge
    // is left out then, whose weight is that of the others.
    void merge() {
        const std::size_t before = made_;
        for (const std::uint32_t root : roots_) {
            const Edge& edge = best_[root];
            if (edge.from == NONE) continue;
            const std::uint32_t a = root_of(parent_, component_[edge.from]), b = root_of(parent_, component_[edge.to]);
            if (a == b) continue;
            parent_[std::max(a, b)] = std::min(a, b);
            edges_[made_++] = edge;
        }
        if (made_ == before) throw std::logic_error("spanning tree: a round found no edge");
        for (const std::uint32_t root : roots_) parent_[root] = root_of(parent_, root);
        std::size_t left = 0;
        for (const std::uint32_t root : roots_) {
            if (parent_[root] == root) roots_[left++] = root;
        }
        roots_.resize(left);
    }

    void relabel() {
        team_.over(tree_.leaves, 1024, [&](std::size_t begin, std::size_t end) {
            for (std::size_t leaf = begin; leaf < end; ++leaf) {
                Node& node = tree_.nodes[tree_.leaf_node[leaf]];
                const std::size_t from = leaf * LANES, to = std::min<std::size_t>(from + LANES, tree_.count);
                if (node.component != NONE && parent_[node.component] == node.component) continue;
                for (std::size_t i = from; i < to; ++i) component_[i] = parent_[component_[i]];
                bool same = true;
                for (std::size_t i = from + 1; i < to; ++i) same &= component_[i] == component_[from];
                node.component = same ? component_[from] : NONE;
            }
        });
        for (std::size_t i = tree_.nodes.size(); i-- > 0;) {  // children come after their parents
            Node& node = tree_.nodes[i];
            if (i == 1 || node.child & LEAF) continue;
            const std::uint32_t left = tree_.nodes[node.child].component, right = tree_.nodes[node.child + 1].component;
            node.component = left == right ? left : NONE;
        }
    }

    Tree& tree_;
    Neighbourhood& around_;
    Team& team_;
    Array<std::uint32_t> component_, parent_;
    Array<float> bound_;
    Array<std::uint32_t> candidate_;
    Array<std::uint16_t> open_;
    Array<Edge> best_;
    Array<std::uint8_t> locks_;
    Array<Edge> edges_;
    std::vector<std::uint32_t> roots_;
    std::size_t made_ = 0;
};

}  // namespace

Neighbourhood neighbourhood(const Tree& tree, int min_samples, Team& team) {
    Neighbourhood out;
    out.kept = std::min(min_samples, MOST_KEPT);
    out.core = Array<float>(tree.places());
    out.near = Array<std::uint32_t>(std::size_t(tree.places()) * out.kept);
    NeighbourSearch job{};
    job.tree = job.queries = view(tree);
    job.same = true;
    job.k = min_samples;
    job.kept = out.kept;
    job.limit = INFINITE;
    job.last = out.core.data();
    job.index = out.near.data();
    team.over(tree.leaves, CHUNK, [&](std::size_t begin, std::size_t end) {
        Array<char> scratch(std::size_t(128) * min_samples);
        kernels().neighbours(job, begin, end, scratch.data());
    });
    return out;
}

Array<Edge> spanning_tree(Tree& tree, Neighbourhood around, Team& team) {
    if (tree.count < 2) return {};
    return Boruvka(tree, around, team).run();
}

}  // namespace l3ps
