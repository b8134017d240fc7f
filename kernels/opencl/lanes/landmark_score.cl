// Likelihood of a set of features for LANES particles at once: score_features of landmark_score.cl. Sums have the order
// of the scalar kernel.
// requires: lanes/landmark_grid

// Sum log p over features: one work-item takes LANES particles. Missing particles repeat the last one.
kernel void score_features(ARGUMENTS) {
    const int first_particle = LANES * get_global_id(0);
    if (first_particle >= particles) return;
    real p[8][LANES];
    for (int i = 0; i < LANES; ++i) {
        const int n = min(first_particle + i, particles - 1);
        const real4 high = pose[n], low = pose_low[n], place = sensor_place(pose_cell[n], high, low, buckets.size);
        p[0][i] = place.x, p[1][i] = place.y, p[2][i] = place.z, p[3][i] = place.w;
        p[4][i] = high.z, p[5][i] = low.z, p[6][i] = high.w, p[7][i] = low.w;
    }
    const LaneQuad place = {load_lanes(0, p[0]), load_lanes(0, p[1]), load_lanes(0, p[2]), load_lanes(0, p[3])};
    // Directions depend on the headings alone.
    const LaneQuad heading = {0, 0, load_lanes(0, p[4]), load_lanes(0, p[6])};
    const LaneQuad heading_low = {0, 0, load_lanes(0, p[5]), load_lanes(0, p[7])};
    LanePair total = {(lanes)score.constant_term, (lanes)0};
    ilanes impossible = isinf(score.constant_term) ? -1 : 0;
    for (int first = 0; first < features; first += BLOCK_TERMS) {
        const int last = min(first + BLOCK_TERMS, features);
        lanes block = 0;
        for (int k = first; k < last; ++k) {
            global const real *numbers = feature + FEATURE * k;
            const LaneQuad turned = direction_lanes(heading, heading_low, numbers);
#if KNOWN
            const int j = partner[k];
            const LaneQuad off = offset_lanes(in_all_lanes(landmark[j]), place);
            const lanes detected = log_detection_lanes(off, turned, numbers, signature + j, terms, arcs);
#else
            const MatchLanes match =
                search_lanes(landmark, signature, start, place, turned, numbers, terms, arcs, buckets);
            const lanes detected = match.log_p + share;
#endif
            const lanes value = either_lanes(detected, (lanes)numbers[FALSE_POSITIVE]);
#if PER_BEAM
#if KNOWN
            const ilanes chosen = j;
#else
            const ilanes chosen = match.best + share >= numbers[FALSE_POSITIVE] ? match.chosen : (ilanes)-1;
#endif
            for (int i = 0; i < LANES && first_particle + i < particles; ++i) {
                const long at = (long)(first_particle + i) * features + k;
                parts[at] = ((const real *)&value)[i];
                which[at] = ((const int *)&chosen)[i];
            }
#endif
            const ilanes zero = !(value > -INFINITY);
            impossible |= zero;
            block += zero ? (lanes)0 : value;
        }
        total = add_term_lanes(total, block);
    }
    const lanes all = impossible ? (lanes)-INFINITY : score.temperature * (total.x + total.y);
    store_some(all, log_p + first_particle, particles - first_particle);
}

// count_unseen for LANES landmarks of a particle at once, with the same bits: landmarks of neighbouring buckets lie side
// by side, wherever the particles are.

// Return the high parts of the offsets from a sensor to landmarks.
lanes offset_to_lanes(const lanes landmark, const lanes landmark_low, const real place, const real place_low) {
    const LanePair sum = two_sum_lanes(landmark, (lanes)-place);
    return sum.x + (sum.y + (landmark_low - place_low));
}

// The place of a particle's sensor, the axis of its view, and the buckets in its range: first and last column, then
// row.
typedef struct {
    real4 place;
    real cosine, sine;
    int4 buckets;
} Viewer;

// Return the viewer of a particle.
Viewer viewer_of(const int2 cell, const real4 high, const real4 low, const Buckets buckets, const SensorView view) {
    Viewer viewer;
    viewer.place = sensor_place(cell, high, low, buckets.size);
    viewer.cosine = high.z * view.axis_cosine - high.w * view.axis_sine;
    viewer.sine = high.w * view.axis_cosine + high.z * view.axis_sine;
    const real2 x = viewer.place.x, y = viewer.place.z;
    viewer.buckets = touched_buckets(x, y, view.range_max, buckets);
    return viewer;
}

// Return the lanes of landmarks in view that belong to no feature, as -1; indices are landmark indices.
ilanes unseen_lanes(const Viewer *viewer, const LaneQuad at, const ilanes index, global const int *which,
                    const int features, const SensorView view) {
    const lanes x = offset_to_lanes(at.x, at.z, viewer->place.x, viewer->place.y);
    const lanes y = offset_to_lanes(at.y, at.w, viewer->place.z, viewer->place.w);
    const lanes d = sqrt(x * x + y * y);
    ilanes missed = d <= view.range_max;
#if FIELD
    missed &= viewer->cosine * x + viewer->sine * y >= view.least * d;
#endif
    for (int k = 0; k < features; ++k) missed &= index != which[k];
    return missed;
}

// Add log_missed to log_p for every landmark in view that belongs to no feature. One work-item takes LANES particles.
// Neighbours that look into the same buckets, as all do around a tracked pose, share each vector of landmarks.
kernel void count_unseen(ARGUMENTS) {
    const int first = LANES * get_global_id(0), own = min(LANES, particles - first);
    const int count = start[buckets.rows * buckets.cols];
    const ilanes lane = (ilanes)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    Viewer viewer[LANES];
    ilanes unseen[LANES];
    for (int i = 0; i < own; ++i) {
        viewer[i] = viewer_of(pose_cell[first + i], pose[first + i], pose_low[first + i], buckets, view);
        unseen[i] = 0;
    }
    for (int from = 0, until; from < own; from = until) {
        const int4 seen = viewer[from].buckets;
        for (until = from + 1; until < own; ++until) {
            const int4 same = viewer[until].buckets == seen;
            if (!(same.x & same.y & same.z & same.w)) break;
        }
        for (int row = seen.z; row <= seen.w; ++row) {
            // Whole rows are contiguous, so that they are one run.
            const int whole = seen.x == 0 && seen.y == buckets.cols - 1, to = whole ? seen.w : row;
            const int last = start[to * buckets.cols + seen.y + 1];
            for (int j = start[row * buckets.cols + seen.x]; j < last; j += LANES) {
                // A landmark has its low parts behind both coordinates.
                const LaneQuad at = load_places(landmark, j, count);
                const ilanes index = lane + j, there = index < last;
                for (int i = from; i < until; ++i)
                    unseen[i] -= there & unseen_lanes(&viewer[i], at, index, which + (long)(first + i) * features,
                                                      features, view);
            }
            row = to;
        }
    }
    for (int i = 0; i < own; ++i) {
        int total = 0;
        for (int k = 0; k < LANES; ++k) total += ((const int *)&unseen[i])[k];
        if (total > 0) log_p[first + i] += total * view.log_missed;
    }
}
