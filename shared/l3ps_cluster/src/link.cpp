#include "link.hpp"

#include <vector>

namespace l3ps {
namespace {

// Pairs of subtrees instead of pairs of points: a subtree known to be one component is not looked into again, two of
// them of the same component are no pair, and two that lie within the gap altogether are joined unseen. So 30,000
// points within one gap cost no more than as many far apart.
class Linker {
public:
    Linker(const Tree& tree, float limit, Team& team)
        : tree_(tree),
          limit_(limit),
          team_(team),
          parent_(tree.count),
          whole_(tree.nodes.size(), 0),
          first_(tree.nodes.size(), 0) {
        for (std::uint32_t i = 0; i < tree.count; ++i) parent_[i] = i;
        for (std::size_t i = tree.nodes.size(); i-- > 0;) {  // children come after their parents
            if (i == 1) continue;
            const std::uint32_t child = tree.nodes[i].child;
            first_[i] = child & LEAF ? (child & ~LEAF) * LANES : first_[child];
        }
        within(0);
    }

    std::uint32_t root(std::uint32_t of) {
        while (parent_[of] != of) of = parent_[of] = parent_[parent_[of]];
        return of;
    }

private:
    bool leaf(std::uint32_t node) const { return tree_.nodes[node].child & LEAF; }
    std::uint32_t end_of(std::uint32_t first) const { return std::min(first + LANES, tree_.count); }

    void join(std::uint32_t a, std::uint32_t b) {
        a = root(a), b = root(b);
        parent_[std::max(a, b)] = std::min(a, b);
    }

    // Squared distance of the nearest and of the farthest points that two boxes may hold.
    float nearest(std::uint32_t a, std::uint32_t b) const {
        float sum[3];
        for (int axis = 0; axis < 3; ++axis) {
            const Node &one = tree_.nodes[a], &two = tree_.nodes[b];
            const float gap = std::max({one.low[axis] - two.high[axis], two.low[axis] - one.high[axis], 0.0f});
            sum[axis] = gap * gap;
        }
        return (sum[0] + sum[1]) + sum[2];
    }
    float farthest(std::uint32_t a, std::uint32_t b) const {
        float sum[3];
        for (int axis = 0; axis < 3; ++axis) {
            const Node &one = tree_.nodes[a], &two = tree_.nodes[b];
            const float span = std::max(one.high[axis] - two.low[axis], two.high[axis] - one.low[axis]);
            sum[axis] = span * span;
        }
        return (sum[0] + sum[1]) + sum[2];
    }

    void make_whole(std::uint32_t node) {
        if (whole_[node]) return;
        whole_[node] = 1;
        const std::uint32_t first = first_[node];
        if (leaf(node)) {
            for (std::uint32_t i = first + 1; i < end_of(first); ++i) join(first, i);
            return;
        }
        for (const std::uint32_t child : {tree_.nodes[node].child, tree_.nodes[node].child + 1}) {
            make_whole(child);
            join(first, first_[child]);
        }
    }

    // A subtree whose parts turned out to be one component.
    void note_whole(std::uint32_t node) {
        if (whole_[node]) return;
        const std::uint32_t first = first_[node];
        if (leaf(node)) {
            for (std::uint32_t i = first + 1; i < end_of(first); ++i) {
                if (root(i) != root(first)) return;
            }
        } else {
            const std::uint32_t child = tree_.nodes[node].child;
            if (!whole_[child] || !whole_[child + 1] || root(first_[child]) != root(first_[child + 1])) return;
        }
        whole_[node] = 1;
    }

    void within(std::uint32_t node) {
        if (farthest(node, node) <= limit_) return make_whole(node);
        if (leaf(node)) {
            points(first_[node], first_[node], false);
        } else {
            const std::uint32_t child = tree_.nodes[node].child;
            within(child);
            within(child + 1);
            between(child, child + 1);
        }
        note_whole(node);
    }

    void between(std::uint32_t a, std::uint32_t b) {
        if (nearest(a, b) > limit_) return;
        if (whole_[a] && whole_[b] && root(first_[a]) == root(first_[b])) return;
        if (farthest(a, b) <= limit_) {
            make_whole(a);
            make_whole(b);
            return join(first_[a], first_[b]);
        }
        if (leaf(a) && leaf(b)) return points(first_[a], first_[b], whole_[a] && whole_[b]);
        if (leaf(a) || (!leaf(b) && farthest(b, b) > farthest(a, a))) std::swap(a, b);
        if (!leaf(a) && farthest(a, a) > limit_) team_.check();
        std::uint32_t near = tree_.nodes[a].child, far = near + 1;
        if (nearest(far, b) < nearest(near, b)) std::swap(near, far);
        between(near, b);
        between(far, b);
        note_whole(a);
    }

    // Pairs of the points of two leaves, or of one; between two wholes the first pair is enough.
    void points(std::uint32_t a, std::uint32_t b, bool one_is_enough) {
        for (std::uint32_t i = b; i < end_of(b); ++i) {
            float distance[LANES];
            for (std::uint32_t lane = 0; lane < LANES; ++lane) {
                const float dx = tree_.x[a + lane] - tree_.x[i], dy = tree_.y[a + lane] - tree_.y[i],
                            dz = tree_.z[a + lane] - tree_.z[i];
                distance[lane] = (dx * dx + dy * dy) + dz * dz;
            }
            for (std::uint32_t lane = 0; lane < LANES; ++lane) {
                if (!(distance[lane] <= limit_) || a + lane >= tree_.count) continue;
                join(a + lane, i);
                if (one_is_enough) return;
            }
        }
    }

    const Tree& tree_;
    float limit_;
    Team& team_;
    Array<std::uint32_t> parent_;
    Array<std::uint8_t> whole_;
    Array<std::uint32_t> first_;
};

}  // namespace

void link(const Tree& tree, double gap, std::int32_t* labels, Team& team) {
    if (tree.count == 0) return;
    const double scaled = gap / tree.scale;
    Linker linker(tree, static_cast<float>(scaled * scaled), team);
    for (std::uint32_t i = 0; i < tree.count; ++i) labels[tree.original[i]] = static_cast<std::int32_t>(linker.root(i));
    std::vector<std::int32_t> number(tree.count, -1);
    std::int32_t used = 0;
    for (std::uint32_t i = 0; i < tree.count; ++i) {
        std::int32_t& own = number[static_cast<std::size_t>(labels[i])];
        if (own < 0) own = used++;
        labels[i] = own;
    }
}

}  // namespace l3ps
