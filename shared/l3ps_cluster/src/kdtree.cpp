#include "kdtree.hpp"

#include <cmath>
#include <stdexcept>
#include <vector>

namespace l3ps {
namespace {

struct Point {
    float at[3];
    std::uint32_t original;
};

struct Task {
    std::uint32_t node, children, first_leaf, leaves;  // `children`: where the nodes below this one start
};

class Builder {
public:
    Builder(Tree& tree, Array<Point>& points) : tree_(tree), points_(points) {}

    // Bounds the node's points; unless it is a leaf, splits them at the median of the widest axis.
    bool split(const Task& task, Task* halves) {
        Node& node = tree_.nodes[task.node];
        const std::size_t begin = std::size_t(task.first_leaf) * LANES;
        const std::size_t end = std::min<std::size_t>(begin + std::size_t(task.leaves) * LANES, tree_.count);
        bound(node, begin, end);
        node.component = NONE;
        if (task.leaves == 1) {
            node.child = LEAF | task.first_leaf;
            tree_.leaf_node[task.first_leaf] = task.node;
            return false;
        }
        node.child = task.children;
        int axis = 0;
        for (int i = 1; i < 3; ++i) {
            if (node.high[i] - node.low[i] > node.high[axis] - node.low[axis]) axis = i;
        }
        const std::uint32_t left = (task.leaves + 1) / 2;
        const auto less = [axis](const Point& a, const Point& b) { return a.at[axis] < b.at[axis]; };
        Point* all = points_.data();
        std::nth_element(all + begin, all + begin + std::size_t(left) * LANES, all + end, less);
        // A subtree of m leaves has 2 m - 1 nodes, its own included.
        halves[0] = {task.children, task.children + 2, task.first_leaf, left};
        halves[1] = {task.children + 1, task.children + 2 * left, task.first_leaf + left, task.leaves - left};
        return true;
    }

    void below(const Task& task, const Team& team) {
        Task halves[2];
        if (!split(task, halves)) return;
        if (task.leaves > 1000) team.check();
        below(halves[0], team);
        below(halves[1], team);
    }

private:
    void bound(Node& node, std::size_t begin, std::size_t end) const {
        f32x4 low = *reinterpret_cast<const f32x4*>(&points_[begin]), high = low;  // the index rides along unused
        for (std::size_t i = begin + 1; i < end; ++i) {
            const f32x4 at = *reinterpret_cast<const f32x4*>(&points_[i]);
            low = at < low ? at : low;
            high = at > high ? at : high;
        }
        for (int i = 0; i < 3; ++i) node.low[i] = low[i], node.high[i] = high[i];
    }

    Tree& tree_;
    Array<Point>& points_;
};

template <typename Real>
Array<Point> load_points(const Real* from, std::size_t count, int dimensions, const Frame& frame, Team& team) {
    Array<Point> points(count);
    const double factor = std::ldexp(1.0, frame.exponent);
    team.over(count, 1 << 16, [&](std::size_t begin, std::size_t end) {
        for (std::size_t i = begin; i < end; ++i) {
            for (int axis = 0; axis < 3; ++axis) {
                const double value = axis < dimensions ? double(from[i * dimensions + axis]) : 0.0;
                points[i].at[axis] = static_cast<float>((value - frame.centre[axis]) * factor);
            }
            points[i].original = static_cast<std::uint32_t>(i);
        }
    });
    return points;
}

}  // namespace

// Beside a coordinate as large as this, float cannot tell others apart, and squares come near its limit.
constexpr double LARGEST = 1e15;

template <typename Real>
Frame frame_of(const Real* points, std::size_t count, int dimensions, Team& team) {
    struct Bounds {
        double low[3] = {HUGE_VAL, HUGE_VAL, HUGE_VAL}, high[3] = {-HUGE_VAL, -HUGE_VAL, -HUGE_VAL};
        double sum[3] = {0, 0, 0};
        bool finite = true;
    };
    constexpr std::size_t CHUNK = 1 << 16;
    std::vector<Bounds> parts((count + CHUNK - 1) / CHUNK);  // summed in order, whichever thread took which
    team.over(count, CHUNK, [&](std::size_t begin, std::size_t end) {
        Bounds part;
        for (std::size_t i = begin; i < end; ++i) {
            for (int axis = 0; axis < dimensions; ++axis) {
                const double value = points[i * dimensions + axis];
                part.finite &= std::abs(value) < LARGEST;  // false for what is not finite too
                part.low[axis] = value < part.low[axis] ? value : part.low[axis];
                part.high[axis] = value > part.high[axis] ? value : part.high[axis];
                part.sum[axis] += value / double(count);
            }
        }
        parts[begin / CHUNK] = part;
    });
    Frame frame;
    double largest = 0;
    for (int axis = 0; axis < dimensions; ++axis) {
        if (sizeof(Real) > sizeof(float)) {
            for (const Bounds& part : parts) frame.centre[axis] += part.sum[axis];
        }
        for (const Bounds& part : parts) {
            if (!part.finite) 
                throw std::invalid_argument("points: every coordinate must be a finite number below 1e15");
            largest = std::max({largest, std::abs(part.low[axis] - frame.centre[axis]),
                                std::abs(part.high[axis] - frame.centre[axis])});
        }
    }
    // Squares of distances must neither overflow nor vanish in float: outlandish coordinates are scaled by a power of
    // two, which loses nothing.
    if (largest > 1e15 || (largest > 0 && largest < 1e-9)) frame.exponent = -std::ilogb(largest);
    return frame;
}

template <typename Real>
Tree build_tree(const Real* from, std::size_t count, int dimensions, const Frame& frame, Team& team) {
    if (count > (std::size_t(1) << 31) - 1024) throw std::invalid_argument("points: at most two billion");
    Tree tree;
    tree.count = static_cast<std::uint32_t>(count);
    tree.leaves = (tree.count + LANES - 1) / LANES;
    tree.scale = std::ldexp(1.0, -frame.exponent);
    if (count == 0) return tree;
    Array<Point> points = load_points(from, count, dimensions, frame, team);
    tree.nodes = Array<Node>(2 * std::size_t(tree.leaves));
    tree.leaf_node = Array<std::uint32_t>(tree.leaves);

    Builder builder(tree, points);
    std::vector<Task> front{{0, 2, 0, tree.leaves}};
    // The same splits whatever the number of threads: those near the root one level at a time, the rest one subtree
    // each.
    while (!front.empty() && front.size() < 8 * std::size_t(team.threads())) {
        std::vector<Task> halves(2 * front.size());
        std::vector<char> inner(front.size());
        team.over(front.size(), 1,
                  [&](std::size_t i, std::size_t) { inner[i] = builder.split(front[i], &halves[2 * i]); });
        std::vector<Task> next;
        for (std::size_t i = 0; i < front.size(); ++i) {
            if (inner[i]) next.insert(next.end(), {halves[2 * i], halves[2 * i + 1]});
        }
        front.swap(next);
    }
    team.over(front.size(), 1, [&](std::size_t i, std::size_t) { builder.below(front[i], team); });

    const std::size_t places = tree.places();
    tree.x = Array<float>(places), tree.y = Array<float>(places), tree.z = Array<float>(places);
    tree.original = Array<std::uint32_t>(places);
    team.over(places, 1 << 16, [&](std::size_t begin, std::size_t end) {
        for (std::size_t i = begin; i < end; ++i) {
            const Point point = i < count ? points[i] : Point{{FAR, FAR, FAR}, NONE};
            tree.x[i] = point.at[0], tree.y[i] = point.at[1], tree.z[i] = point.at[2];
            tree.original[i] = point.original;
        }
    });
    return tree;
}

template Frame frame_of<float>(const float*, std::size_t, int, Team&);
template Frame frame_of<double>(const double*, std::size_t, int, Team&);
template Tree build_tree<float>(const float*, std::size_t, int, const Frame&, Team&);
template Tree build_tree<double>(const double*, std::size_t, int, const Frame&, Team&);

}  // namespace l3ps
