// Negative information: count_unseen of landmark_unseen.cl, for LANES landmarks of a particle at once, with the same
// bits. Landmarks of neighbouring buckets lie side by side, so that it does not matter how particles lie.
// requires: landmark_grid lanes/offsets

// Return the high parts of the offsets from a sensor to landmarks.
lanes offset_to_lanes(const lanes landmark, const lanes landmark_low, const real place, const real place_low) {
    const LanePair sum = two_sum_lanes(landmark, (lanes)-place);
    return sum.hi + (sum.lo + (landmark_low - place_low));
}

// Add log_missed to log_p for every landmark in view that belongs to no feature. One work-item takes a particle.
kernel void count_unseen(ARGUMENTS) {
    const int n = get_global_id(0);
    if (n >= particles) return;
    const real4 sensor_pose = pose[n], place = sensor_place(pose_cell[n], sensor_pose, pose_low[n], buckets.size);
    const real cosine = sensor_pose.z * view.axis_cosine - sensor_pose.w * view.axis_sine;
    const real sine = sensor_pose.w * view.axis_cosine + sensor_pose.z * view.axis_sine;
    const int left = bucket_at(place.x - view.range_max, buckets.size, buckets.cols);
    const int right = bucket_at(place.x + view.range_max, buckets.size, buckets.cols);
    const int high = bucket_at(place.z + view.range_max, buckets.size, buckets.rows);
    const int count = start[buckets.rows * buckets.cols];
    const ilanes lane = (ilanes)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    ilanes unseen = 0;
    for (int row = bucket_at(place.z - view.range_max, buckets.size, buckets.rows); row <= high; ++row) {
        // Whole rows follow one another.
        const int whole = left == 0 && right == buckets.cols - 1, until = whole ? high : row;
        const int last = start[until * buckets.cols + right + 1];
        for (int j = start[row * buckets.cols + left]; j < last; j += LANES) {
            // A landmark has its low parts behind both coordinates.
            const LanePlace at = load_places(landmark, j, count);
            const lanes x = offset_to_lanes(at.x.hi, at.y.hi, place.x, place.y);
            const lanes y = offset_to_lanes(at.x.lo, at.y.lo, place.z, place.w);
            const lanes d = sqrt(x * x + y * y);
            const ilanes index = lane + j;
            ilanes missed = (index < last) & (d <= view.range_max) & (cosine * x + sine * y >= view.least * d);
            if (!any_lane(missed)) continue;
            for (int k = 0; k < features; ++k) missed &= index != which[(long)n * features + k];
            unseen -= missed;
        }
        row = until;
    }
    int total = 0;
    for (int i = 0; i < LANES; ++i) total += ((const int *)&unseen)[i];
    if (total > 0) log_p[n] += total * view.log_missed;
}
