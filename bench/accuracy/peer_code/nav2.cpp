// nav2_amcl's laser models as one C function, and its filter; compiled_peers.py compiles it against a copy of
// navigation2. The brushfire of map_cspace.cpp is included, so that its table of distances is at hand.
#include <cmath>
#include <cstdlib>

#include "src/map/map_cspace.cpp"
#include "nav2_amcl/angleutils.hpp"
#include "nav2_amcl/motion_model/differential_motion_model.hpp"
#include "nav2_amcl/sensors/laser/laser.hpp"

namespace {
double *result;
}

// The particle filter's own, renamed when pf.c is compiled.
extern "C" void filter_update_sensor(pf_t *, pf_sensor_model_fn_t sensor_fn, void *data);

// In place of the particle filter's: without a filter one sample at a time, of weight 1.
extern "C" void pf_update_sensor(pf_t *pf, pf_sensor_model_fn_t sensor_fn, void *data) {
    if (pf) return filter_update_sensor(pf, sensor_fn, data);
    pf_sample_set_t *set = reinterpret_cast<pf_sample_set_t *>(result);
    sensor_fn(data, set);
}

namespace {
struct Made {
    map_t *map;
    nav2_amcl::Laser *laser;
};

map_t *map_of(const signed char *cells, int rows, int cols, const double *geometry) {
    map_t *map = map_alloc();
    map->size_x = cols;
    map->size_y = rows;
    map->scale = geometry[0];
    map->origin_x = geometry[1] + (cols / 2) * map->scale;
    map->origin_y = geometry[2] + (rows / 2) * map->scale;
    map->cells = static_cast<map_cell_t *>(std::malloc(sizeof(map_cell_t) * rows * cols));
    // The rule of AmclNode::convertMap.
    for (int i = 0; i < rows * cols; ++i) map->cells[i].occ_state = cells[i] == 0 ? -1 : cells[i] == 100 ? 1 : 0;
    return map;
}
}  // namespace

// Make a model for scans of k readings. model: 0 beam, 1 likelihood field, 2 its product form. p = {z_hit, z_short,
// z_max, z_rand, sigma_hit, lambda_short, max_occ_dist}. With nearest (the index of the nearest obstacle of each cell,
// -1 without one) distances are exact.
extern "C" void *prepare(const signed char *cells, int rows, int cols, const double *geometry, const double *p,
                         int model, int, int k, double, const long *nearest) {
    map_t *map = map_of(cells, rows, cols, geometry);
    nav2_amcl::Laser *laser;
    if (model == 0) {
        laser = new nav2_amcl::BeamModel(p[0], p[1], p[2], p[3], p[4], p[5], 0, k, map);
    } else if (model == 1) {
        laser = new nav2_amcl::LikelihoodFieldModel(p[0], p[3], p[4], p[6], k, map);
    } else {
        laser = new nav2_amcl::LikelihoodFieldModelProb(p[0], p[3], p[4], p[6], false, 0.5, 0.3, 0.9, k, map);
    }
    if (model != 0 && nearest) {
        CachedDistanceMap *table = get_distance_map(map->scale, map->max_occ_dist);
        for (int i = 0; i < rows * cols; ++i) {
            map->cells[i].occ_dist = map->max_occ_dist;
            if (nearest[i] < 0) continue;
            const int across = std::abs(int(nearest[i] % cols) - i % cols), up = std::abs(int(nearest[i] / cols) - i / cols);
            if (std::max(across, up) > table->cell_radius_ + 1) continue;
            const double distance = table->distances_[across][up];
            if (distance <= table->cell_radius_) map->cells[i].occ_dist = distance * map->scale;
        }
    }
    pf_vector_t nowhere = pf_vector_zero();
    laser->SetLaserPose(nowhere);
    return new Made{map, laser};
}

// Fill in a scan of k readings.
static void fill(nav2_amcl::LaserData &data, void *made, const double *ranges, const double *bearings, int k,
                 double range_min, double range_max) {
    data.laser = static_cast<Made *>(made)->laser;
    data.range_count = k;
    data.range_max = range_max;
    data.ranges = new double[k][2];
    for (int i = 0; i < k; ++i) {
        // The rule of AmclNode::updateFilter.
        data.ranges[i][0] = ranges[i] <= range_min ? range_max : ranges[i];
        data.ranges[i][1] = bearings[i];
    }
}

// Weigh n poses with a scan of k readings.
extern "C" void weigh(void *made, const double *poses, int n, const double *ranges, const double *bearings, int k,
                      double range_min, double range_max, double *weights) {
    nav2_amcl::LaserData data;
    fill(data, made, ranges, bearings, k, range_min, range_max);
    pf_sample_t *samples = new pf_sample_t[n];
    for (int j = 0; j < n; ++j) {
        samples[j].weight = 1;
        for (int i = 0; i < 3; ++i) samples[j].pose.v[i] = poses[3 * j + i];
    }
    pf_sample_set_t set = {};
    set.sample_count = n;
    set.samples = samples;
    result = reinterpret_cast<double *>(&set);
    data.laser->sensorUpdate(nullptr, &data);
    for (int j = 0; j < n; ++j) weights[j] = samples[j].weight;
    delete[] samples;
}

extern "C" void discard(void *made) {
    Made *one = static_cast<Made *>(made);
    delete one->laser;
    map_free(one->map);
    delete one;
}

// Score n poses with a scan of k readings, all at once; field takes the distances.
extern "C" void score(const signed char *cells, int rows, int cols, const double *geometry, const double *p, int model,
                      int options, const double *poses, int n, const double *ranges, const double *bearings, int k,
                      double range_min, double range_max, const long *nearest, double *weights, float *field) {
    void *made = prepare(cells, rows, cols, geometry, p, model, options, k, range_max, nearest);
    const map_cell_t *distances = static_cast<Made *>(made)->map->cells;
    for (int i = 0; model != 0 && field && i < rows * cols; ++i) field[i] = distances[i].occ_dist;
    weigh(made, poses, n, ranges, bearings, k, range_min, range_max, weights);
    discard(made);
}

// Return the range of the map alone.
extern "C" void cast(const signed char *cells, int rows, int cols, const double *geometry, const double *poses, int n,
                     const double *bearings, int k, double range_max, double *expected) {
    map_t *map = map_of(cells, rows, cols, geometry);
    for (int j = 0; j < n; ++j)
        for (int i = 0; i < k; ++i)
            expected[j * k + i] =
                map_calc_range(map, poses[3 * j], poses[3 * j + 1], poses[3 * j + 2] + bearings[i], range_max);
    map_free(map);
}

namespace {
struct Filter {
    void *made;
    pf_t *pf;
    nav2_amcl::DifferentialMotionModel motion;
    pf_vector_t odometry;
    bool moved;
};
}  // namespace

// Start a filter of n particles around a pose, with standard deviations of x, y and heading, and the model of prepare.
// The number of particles is fixed; errors of the KLD bound are the defaults, and no random poses are injected.
extern "C" void *start(void *made, int n, const double *mean, const double *deviations, const double *alpha, int seed) {
    Filter *filter = new Filter{made, pf_alloc(n, n, 0, 0, nullptr), {}, pf_vector_zero(), false};
    srand48(seed);
    filter->pf->pop_err = 0.05;
    filter->pf->pop_z = 0.99;
    pf_vector_t center = pf_vector_zero();
    pf_matrix_t spread = pf_matrix_zero();
    for (int i = 0; i < 3; ++i) {
        center.v[i] = mean[i];
        spread.m[i][i] = deviations[i] * deviations[i];
    }
    pf_init(filter->pf, center, spread);
    filter->motion.initialize(alpha[0], alpha[1], alpha[2], alpha[3], 0);
    return filter;
}

// Move by the odometry, weigh by a scan of k readings, resample, and return the mean of the heaviest cluster.
extern "C" void step(void *given, const double *odometry, const double *ranges, const double *bearings, int k,
                     double range_min, double range_max, double *found) {
    Filter *filter = static_cast<Filter *>(given);
    pf_vector_t pose, delta;
    for (int i = 0; i < 3; ++i) {
        pose.v[i] = odometry[i];
        delta.v[i] = pose.v[i] - filter->odometry.v[i];
    }
    delta.v[2] = nav2_amcl::angleutils::angle_diff(pose.v[2], filter->odometry.v[2]);
    if (filter->moved) filter->motion.odometryUpdate(filter->pf, pose, delta);
    filter->odometry = pose;
    filter->moved = true;
    nav2_amcl::LaserData data;
    fill(data, filter->made, ranges, bearings, k, range_min, range_max);
    data.laser->sensorUpdate(filter->pf, &data);
    pf_update_resample(filter->pf, nullptr);
    const int clusters = filter->pf->sets[filter->pf->current_set].cluster_count;
    double heaviest = 0, weight;
    for (int i = 0; i < clusters; ++i) {
        pf_vector_t mean;
        pf_matrix_t spread;
        if (!pf_get_cluster_stats(filter->pf, i, &weight, &mean, &spread) || weight <= heaviest) continue;
        heaviest = weight;
        for (int j = 0; j < 3; ++j) found[j] = mean.v[j];
    }
}

extern "C" void stop(void *given) {
    Filter *filter = static_cast<Filter *>(given);
    pf_free(filter->pf);
    delete filter;
}
