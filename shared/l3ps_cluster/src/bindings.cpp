// What Python sees. Arrays come checked from __init__.py: rows of two or three coordinates, C-contiguous.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cmath>
#include <limits>

#include "hierarchy.hpp"
#include "link.hpp"
#include "nearest.hpp"
#include "spanning_tree.hpp"
#include "supervise.hpp"

namespace nb = nanobind;
using namespace nb::literals;
using namespace l3ps;

namespace {

template <typename T>
using Rows = nb::ndarray<const T, nb::numpy, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Labels = nb::ndarray<const std::int32_t, nb::numpy, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

// A new NumPy array, before it is one: C++ fills it in any thread, `give` hands it over.
template <typename T>
class Result {
public:
    explicit Result(std::size_t rows, std::size_t columns = 0)
        : rows_(rows), columns_(columns), data_(new T[rows * (columns ? columns : 1)]) {}
    T* data() { return data_.get(); }
    nb::ndarray<nb::numpy, T> give() {
        T* data = data_.release();
        const nb::capsule owner(data, [](void* p) noexcept { delete[] static_cast<T*>(p); });
        const std::size_t shape[2] = {rows_, columns_};
        return nb::ndarray<nb::numpy, T>(data, columns_ ? 2 : 1, shape, owner);
    }

private:
    std::size_t rows_, columns_;
    std::unique_ptr<T[]> data_;
};

template <typename T>
Tree tree_of(const Rows<T>& points, const Frame& frame, Team& team) {
    return build_tree(points.data(), points.shape(0), static_cast<int>(points.shape(1)), frame, team);
}

template <typename T>
Frame frame_of(const Rows<T>& points, Team& team) {
    return l3ps::frame_of(points.data(), points.shape(0), static_cast<int>(points.shape(1)), team);
}

template <typename T>
nb::tuple hdbscan(Rows<T> points, std::uint32_t min_cluster_size, int min_samples, bool keep_tree, int threads,
                  nb::object cancel) {
    const std::size_t count = points.shape(0), kept = keep_tree && count ? count - 1 : 0;
    Result<std::int32_t> labels(count), ends(kept, 2);
    Result<double> weights(kept);
    double total = 0;
    Team team(threads);
    supervise(team, cancel, [&] {
        Tree tree = tree_of(points, frame_of(points, team), team);
        Array<Edge> edges = spanning_tree(tree, neighbourhood(tree, min_samples, team), team);
        sort_edges(edges, tree.original, team);
        label_points(edges, tree, min_cluster_size, labels.data(), team);
        for (std::size_t i = 0; i < edges.size(); ++i) {
            const double weight = std::sqrt(double(edges[i].weight)) * tree.scale;
            total += weight;
            if (!keep_tree) continue;
            ends.data()[2 * i] = static_cast<std::int32_t>(tree.original[edges[i].from]);
            ends.data()[2 * i + 1] = static_cast<std::int32_t>(tree.original[edges[i].to]);
            weights.data()[i] = weight;
        }
    });
    return nb::make_tuple(labels.give(), total, ends.give(), weights.give());
}

nb::tuple nearest_points(Rows<float> points, Rows<float> queries, int k, double max_distance, int threads,
                         nb::object cancel) {
    Result<float> distance(queries.shape(0), k);
    Result<std::int32_t> index(queries.shape(0), k);
    Team team(threads);
    supervise(team, cancel, [&] {
        Frame frame = frame_of(points, team), other = frame_of(queries, team);
        frame.exponent = std::min(frame.exponent, other.exponent);
        const Tree tree = tree_of(points, frame, team), asked = tree_of(queries, frame, team);
        const double reach = max_distance / tree.scale;
        // The search takes what is nearer than its limit, the caller what is no farther.
        const float limit = std::nextafter(static_cast<float>(reach * reach), std::numeric_limits<float>::infinity());
        nearest(tree, asked, k, limit, distance.data(), index.data(), team);
    });
    return nb::make_tuple(distance.give(), index.give());
}

nb::ndarray<nb::numpy, std::int32_t> link_points(Rows<float> points, double gap, int threads, nb::object cancel) {
    Result<std::int32_t> labels(points.shape(0));
    Team team(threads);
    supervise(team, cancel, [&] { link(tree_of(points, frame_of(points, team), team), gap, labels.data(), team); });
    return labels.give();
}

template <typename T>
nb::ndarray<nb::numpy, std::int32_t> fill(Rows<T> points, Labels labels, int k, int threads, nb::object cancel) {
    Result<std::int32_t> filled(points.shape(0));
    Team team(threads);
    supervise(team, cancel, [&] {
        fill_noise(points.data(), points.shape(0), static_cast<int>(points.shape(1)), labels.data(), k, filled.data(),
                   team);
    });
    return filled.give();
}

template <typename T>
void define(nb::module_& module) {
    module.def("hdbscan", &hdbscan<T>, "points"_a, "min_cluster_size"_a, "min_samples"_a, "keep_tree"_a, "threads"_a,
               "cancel"_a.none());
    module.def("fill_noise", &fill<T>, "points"_a, "labels"_a, "k"_a, "threads"_a, "cancel"_a.none());
}

}  // namespace

NB_MODULE(_core, module) {
    define<float>(module);
    define<double>(module);
    module.def("nearest", &nearest_points, "points"_a, "queries"_a, "k"_a, "max_distance"_a, "threads"_a,
               "cancel"_a.none());
    module.def("link", &link_points, "points"_a, "gap"_a, "threads"_a, "cancel"_a.none());
    module.def("instruction_set", [] { return kernels().name; });
    module.def("choose_instruction_set", &choose_kernels, "name"_a);
}
