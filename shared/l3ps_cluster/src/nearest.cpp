#include "nearest.hpp"

#include <cmath>
#include <limits>
#include <utility>
#include <vector>

#include "kernels.hpp"

namespace l3ps {
namespace {

constexpr float INFINITE = std::numeric_limits<float>::infinity();
constexpr std::size_t CHUNK = 64;
// Float32 arithmetic is off by less than this share of a squared distance.
constexpr float SLACK = 1e-6f;

// One query in float64 by brute descent: for the few whose k-th and next neighbour float32 cannot tell apart.
class ExactSearch {
public:
    ExactSearch(const Tree& tree, double x, double y, double z, std::size_t k, float reach)
        : tree_(tree), at_{x, y, z}, k_(k), reach_(reach * (1.0 + SLACK)) {
        below(0);
    }
    std::uint32_t index(std::size_t i) const { return found_[i].second; }

private:
    void below(std::uint32_t number) {
        const Node& node = tree_.nodes[number];
        double gap = 0;
        for (int axis = 0; axis < 3; ++axis) {
            const double outside =
                std::max({double(node.low[axis]) - at_[axis], at_[axis] - double(node.high[axis]), 0.0});
            gap += outside * outside;
        }
        if (gap > (found_.size() == k_ ? found_.back().first : reach_)) return;
        if (!(node.child & LEAF)) {
            below(node.child);
            below(node.child + 1);
            return;
        }
        const std::uint32_t begin = (node.child & ~LEAF) * LANES, end = std::min(begin + LANES, tree_.count);
        for (std::uint32_t i = begin; i < end; ++i) {
            const double dx = tree_.x[i] - at_[0], dy = tree_.y[i] - at_[1], dz = tree_.z[i] - at_[2];
            const std::pair<double, std::uint32_t> entry{dx * dx + dy * dy + dz * dz, tree_.original[i]};
            if (entry.first > reach_ || (found_.size() == k_ && !(entry < found_.back()))) continue;
            if (found_.size() == k_) found_.pop_back();
            found_.insert(std::upper_bound(found_.begin(), found_.end(), entry), entry);
        }
    }

    const Tree& tree_;
    double at_[3];
    std::size_t k_;
    double reach_;
    std::vector<std::pair<double, std::uint32_t>> found_;
};

// Runs the search over chunks of query leaves and hands each query's lists on: use(place, distances, indices) with a
// step of LANES between neighbours.
template <typename Use>
void search(const Tree& tree, const Tree& queries, int k, float limit, Team& team, Use&& use) {
    if (queries.count == 0) return;
    NeighbourSearch job{};
    job.tree = view(tree);
    job.queries = view(queries);
    job.k = job.kept = k;
    job.limit = limit;
    team.over(queries.leaves, CHUNK, [&](std::size_t begin, std::size_t end) {
        const std::size_t block = std::size_t(k) * LANES;
        Array<char> scratch(block * 8);
        Array<float> distance((end - begin) * block);
        Array<std::uint32_t> index((end - begin) * block);
        NeighbourSearch part = job;
        part.first_written = static_cast<std::uint32_t>(begin);
        part.distance = distance.data();
        part.index = index.data();
        kernels().neighbours(part, static_cast<std::uint32_t>(begin), static_cast<std::uint32_t>(end), scratch.data());
        const std::size_t last = std::min<std::size_t>(end * LANES, queries.count);
        for (std::size_t place = begin * LANES; place < last; ++place) {
            const std::size_t at = (place / LANES - begin) * block + place % LANES;
            use(static_cast<std::uint32_t>(place), distance.data() + at, index.data() + at);
        }
    });
}

}  // namespace

void nearest(const Tree& tree, const Tree& queries, int k, float limit, float* distance, std::int32_t* index,
             Team& team) {
    if (tree.count == 0) {
        for (std::size_t i = 0; i < std::size_t(queries.count) * k; ++i) distance[i] = INFINITE, index[i] = -1;
        return;
    }
    search(tree, queries, k, limit, team, [&](std::uint32_t place, const float* squared, const std::uint32_t* found) {
        const std::size_t row = std::size_t(queries.original[place]) * k;
        for (int i = 0; i < k; ++i) {
            const std::uint32_t other = found[i * LANES];
            distance[row + i] = static_cast<float>(std::sqrt(double(squared[i * LANES])) * tree.scale);
            index[row + i] = other == NONE ? -1 : static_cast<std::int32_t>(tree.original[other]);
        }
    });
}

namespace {

// Each query's k nearest points by float64 distance, then index: use(query, indices). The tree has k points or more.
template <typename Use>
void nearest_exactly(const Tree& tree, const Tree& queries, int k, Team& team, Use&& use) {
    search(tree, queries, k + 1, INFINITE, team,
           [&](std::uint32_t place, const float* squared, const std::uint32_t* found) {
               std::vector<std::uint32_t> row(static_cast<std::size_t>(k));
               const float last = squared[(k - 1) * LANES], next = squared[k * LANES];
               if (next <= last * (1 + SLACK)) {
                   const ExactSearch exact(tree, queries.x[place], queries.y[place], queries.z[place], row.size(),
                                           last);
                   for (std::size_t i = 0; i < row.size(); ++i) row[i] = exact.index(i);
               } else {
                   for (std::size_t i = 0; i < row.size(); ++i) row[i] = tree.original[found[i * LANES]];
               }
               use(queries.original[place], row);
           });
}

std::int32_t most_frequent(std::vector<std::int32_t>& labels) {
    std::sort(labels.begin(), labels.end());
    std::int32_t best = labels[0];
    for (std::size_t i = 0, most = 0; i < labels.size();) {
        std::size_t end = i;
        while (end < labels.size() && labels[end] == labels[i]) ++end;
        if (end - i > most) most = end - i, best = labels[i];
        i = end;
    }
    return best;
}

}  // namespace

template <typename Real>
void fill_noise(const Real* points, std::size_t count, int dimensions, const std::int32_t* labels, int k,
                std::int32_t* filled, Team& team) {
    std::vector<std::uint32_t> clustered, noise;
    for (std::size_t i = 0; i < count; ++i) {
        filled[i] = labels[i];
        (labels[i] < 0 ? noise : clustered).push_back(static_cast<std::uint32_t>(i));
    }
    if (noise.empty() || clustered.empty()) return;
    const Frame frame = frame_of(points, count, dimensions, team);
    const auto tree_of = [&](const std::vector<std::uint32_t>& chosen) {
        Array<Real> rows(chosen.size() * dimensions);
        for (std::size_t i = 0; i < rows.size(); ++i)
            rows[i] = points[std::size_t(chosen[i / dimensions]) * dimensions + i % dimensions];
        return build_tree(rows.data(), chosen.size(), dimensions, frame, team);
    };
    const int wanted = static_cast<int>(std::min<std::size_t>(k, clustered.size()));
    nearest_exactly(tree_of(clustered), tree_of(noise), wanted, team,
                    [&](std::uint32_t query, const std::vector<std::uint32_t>& found) {
                        std::vector<std::int32_t> votes;
                        for (const std::uint32_t at : found) votes.push_back(labels[clustered[at]]);
                        filled[noise[query]] = most_frequent(votes);
                    });
}

template void fill_noise<float>(const float*, std::size_t, int, const std::int32_t*, int, std::int32_t*, Team&);
template void fill_noise<double>(const double*, std::size_t, int, const std::int32_t*, int, std::int32_t*, Team&);

}  // namespace l3ps
