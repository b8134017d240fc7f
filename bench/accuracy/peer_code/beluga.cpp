// Beluga's laser models as one C function, and its filter; compiled_peers.py compiles it against a copy of Beluga.
// Its distance transform is renamed, so that exact distances can take its place.
#define nearest_obstacle_distance_map inexact_distance_map
#include <beluga/algorithm/distance_map.hpp>
#undef nearest_obstacle_distance_map

#include <type_traits>
#include <vector>

namespace {
// The index of the nearest obstacle of each cell, -1 without one; null for Beluga's transform.
const long *nearest_obstacle;
}  // namespace

namespace beluga {
template <class Range, class Distance, class Neighbors>
auto nearest_obstacle_distance_map(Range &&mask, Distance &&distance, Neighbors &&neighbors,
                                   std::invoke_result_t<Distance, std::size_t, std::size_t> most) {
    if (!nearest_obstacle) return inexact_distance_map(mask, distance, neighbors, most);
    std::vector<std::invoke_result_t<Distance, std::size_t, std::size_t>> map(ranges::size(mask), most);
    for (std::size_t i = 0; i < map.size(); ++i)
        if (nearest_obstacle[i] >= 0) map[i] = std::min(most, distance(nearest_obstacle[i], i));
    return map;
}
}  // namespace beluga

#include <beluga/algorithm/amcl_core.hpp>
#include <beluga/motion/differential_drive_model.hpp>
#include <beluga/random.hpp>
#include <beluga/sensor/beam_model.hpp>
#include <beluga/sensor/data/laser_scan.hpp>
#include <beluga/sensor/likelihood_field_model.hpp>
#include <beluga/sensor/likelihood_field_prob_model.hpp>

namespace {

struct Grid : beluga::BaseOccupancyGrid2<Grid> {
    // The values of beluga_ros::OccupancyGrid.
    struct Traits {
        static bool is_free(signed char value) { return value == 0; }
        static bool is_unknown(signed char value) { return value == -1; }
        static bool is_occupied(signed char value) { return value == 100; }
    };
    Grid(const signed char *cells, int rows, int cols, const double *geometry)
        : data_(cells, cells + rows * cols), cols_(cols), resolution_(geometry[0]),
          origin_(Sophus::SO2d{geometry[3]}, Eigen::Vector2d{geometry[1], geometry[2]}) {}
    const Sophus::SE2d &origin() const { return origin_; }
    std::size_t size() const { return data_.size(); }
    const auto &data() const { return data_; }
    std::size_t width() const { return cols_; }
    std::size_t height() const { return data_.size() / cols_; }
    double resolution() const { return resolution_; }
    static auto value_traits() { return Traits{}; }

   private:
    std::vector<signed char> data_;
    std::size_t cols_;
    double resolution_;
    Sophus::SE2d origin_;
};

struct Scan : beluga::BaseLaserScan<Scan> {
    using Scalar = double;
    std::vector<double> ranges_, angles_;
    double least, most;
    const auto &ranges() const { return ranges_; }
    const auto &angles() const { return angles_; }
    double min_range() const { return least; }
    double max_range() const { return most; }
};

Sophus::SE2d state(const double *pose) { return {Sophus::SO2d{pose[2]}, Eigen::Vector2d{pose[0], pose[1]}}; }

using Points = std::vector<std::pair<double, double>>;

// A filter: moves by the odometry, weighs by a scan, resamples, and returns the weighted mean.
struct Filter {
    virtual ~Filter() = default;
    virtual Sophus::SE2d step(Sophus::SE2d odometry, Points points) = 0;
};

template <class Model>
struct FilterOf : Filter {
    using Anywhere = std::function<Sophus::SE2d()>;
    beluga::Amcl<beluga::DifferentialDriveModel2d, Model, Anywhere> amcl;
    FilterOf(const Model &model, const beluga::DifferentialDriveModelParam &motion, beluga::AmclParams params)
        : amcl(beluga::DifferentialDriveModel2d{motion}, model, [] { return Sophus::SE2d{}; },
               beluga::spatial_hash<Sophus::SE2d>{0.5, 0.5, 10 * M_PI / 180}, params) {}
    Sophus::SE2d step(Sophus::SE2d odometry, Points points) override {
        amcl.force_update();
        return std::get<0>(*amcl.update(odometry, std::move(points)));
    }
};

struct Made {
    virtual ~Made() = default;
    virtual Filter *start(const beluga::DifferentialDriveModelParam &motion, const beluga::AmclParams &params,
                          const Sophus::SE2d &mean, const Eigen::Matrix3d &covariance) const = 0;
    virtual void weigh(Points points, const double *poses, int n, double *weights) const = 0;
    virtual void copy(float *field) const = 0;
};

template <class Model, bool with_field>
struct Of : Made {
    Model model;
    template <class... Given>
    explicit Of(Given &&...given) : model(std::forward<Given>(given)...) {}
    void weigh(Points points, const double *poses, int n, double *weights) const override {
        const auto weight = model(std::move(points));
        for (int j = 0; j < n; ++j) weights[j] = weight(state(poses + 3 * j));
    }
    Filter *start(const beluga::DifferentialDriveModelParam &motion, const beluga::AmclParams &params,
                  const Sophus::SE2d &mean, const Eigen::Matrix3d &covariance) const override {
        auto *made = new FilterOf<Model>(model, motion, params);
        made->amcl.initialize(mean, covariance);
        return made;
    }
    void copy(float *field) const override {
        if constexpr (with_field) {
            const auto &cells = model.likelihood_field().data();
            for (std::size_t i = 0; i < cells.size(); ++i) field[i] = cells[i];
        }
    }
};

}  // namespace

// Make a model, with its likelihood field; see nav2.cpp. options: 1 model_unknown_space, 2 only_obstacle_boundaries.
extern "C" void *prepare(const signed char *cells, int rows, int cols, const double *geometry, const double *p,
                         int model, int options, int, double range_max, const long *nearest) {
    nearest_obstacle = nearest;
    const Grid grid{cells, rows, cols, geometry};
    const beluga::BeamModelParam beam{p[0], p[1], p[2], p[3], p[4], p[5], range_max};
    const beluga::LikelihoodFieldModelParam param{p[6],  range_max,        p[0],              p[3],
                                                  p[4], (options & 1) != 0, (options & 2) != 0};
    if (model == 0) return static_cast<Made *>(new Of<beluga::BeamSensorModel<Grid>, false>(beam, grid));
    if (model == 1) return static_cast<Made *>(new Of<beluga::LikelihoodFieldModel<Grid>, true>(param, grid));
    return static_cast<Made *>(new Of<beluga::LikelihoodFieldProbModel<Grid>, true>(param, grid));
}

// Return the end points of a scan.
static Points points_of(const double *ranges, const double *bearings, int k, double range_min, double range_max) {
    Scan scan;
    scan.ranges_.assign(ranges, ranges + k);
    scan.angles_.assign(bearings, bearings + k);
    scan.least = range_min;
    scan.most = range_max;
    Points points;
    for (const auto &point : scan.points_in_cartesian_coordinates()) points.emplace_back(point.x(), point.y());
    return points;
}

// Weigh n poses with a scan of k readings.
extern "C" void weigh(void *made, const double *poses, int n, const double *ranges, const double *bearings, int k,
                      double range_min, double range_max, double *weights) {
    auto points = points_of(ranges, bearings, k, range_min, range_max);
    static_cast<Made *>(made)->weigh(std::move(points), poses, n, weights);
}

extern "C" void discard(void *made) { delete static_cast<Made *>(made); }

// Score n poses with a scan of k readings, all at once.
extern "C" void score(const signed char *cells, int rows, int cols, const double *geometry, const double *p, int model,
                      int options, const double *poses, int n, const double *ranges, const double *bearings, int k,
                      double range_min, double range_max, const long *nearest, double *weights, float *field) {
    void *made = prepare(cells, rows, cols, geometry, p, model, options, k, range_max, nearest);
    if (field) static_cast<Made *>(made)->copy(field);
    weigh(made, poses, n, ranges, bearings, k, range_min, range_max, weights);
    discard(made);
}

// Return the range of the map alone, range_max without a hit.
extern "C" void cast(const signed char *cells, int rows, int cols, const double *geometry, const double *poses, int n,
                     const double *bearings, int k, double range_max, double *expected) {
    const Grid grid{cells, rows, cols, geometry};
    for (int j = 0; j < n; ++j) {
        const beluga::Ray2d ray{grid, state(poses + 3 * j), range_max};
        for (int i = 0; i < k; ++i) expected[j * k + i] = ray.cast(Sophus::SO2d{bearings[i]}).value_or(range_max);
    }
}

// Start a filter of n particles around a pose; see nav2.cpp.
extern "C" void *start(void *made, int n, const double *mean, const double *deviations, const double *alpha, int seed) {
    ranges::detail::get_random_engine().seed(seed);
    beluga::AmclParams params;
    params.min_particles = params.max_particles = n;
    params.alpha_slow = params.alpha_fast = 0;
    params.kld_epsilon = 0.05;
    params.kld_z = 0.99;
    const Eigen::Vector3d spread{deviations[0], deviations[1], deviations[2]};
    const Eigen::Matrix3d covariance = spread.cwiseAbs2().asDiagonal();
    return static_cast<Made *>(made)->start({alpha[0], alpha[1], alpha[2], alpha[3]}, params, state(mean), covariance);
}

extern "C" void step(void *filter, const double *odometry, const double *ranges, const double *bearings, int k,
                     double range_min, double range_max, double *found) {
    auto points = points_of(ranges, bearings, k, range_min, range_max);
    const auto mean = static_cast<Filter *>(filter)->step(state(odometry), std::move(points));
    found[0] = mean.translation().x();
    found[1] = mean.translation().y();
    found[2] = mean.so2().log();
}

extern "C" void stop(void *filter) { delete static_cast<Filter *>(filter); }
