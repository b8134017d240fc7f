// Negative information: landmarks that the sensor should see from a pose, but that match no feature.
// requires: error_free landmarks landmark_grid

// Return whether a landmark is within range and, with a FIELD, the cosine of its angle to the sensor's axis is at least
// ``least``.
int in_view(const real4 off, const real cosine, const real sine, const real range_max, const real least) {
    const real d = sqrt(off.x * off.x + off.z * off.z);
#if FIELD
    return d <= range_max && cosine * off.x + sine * off.z >= least * d;
#else
    return d <= range_max;
#endif
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
    int unseen = 0;
    for (int row = bucket_at(place.z - view.range_max, buckets.size, buckets.rows); row <= high; ++row) {
        const int last = start[row * buckets.cols + right + 1];
        for (int j = start[row * buckets.cols + left]; j < last; ++j) {
            if (!in_view(offset(landmark[j], place), cosine, sine, view.range_max, view.least)) continue;
            int taken = 0;
            for (int k = 0; k < features; ++k) taken |= which[(long)n * features + k] == j;
            unseen += !taken;
        }
    }
    if (unseen > 0) log_p[n] += unseen * view.log_missed;
}
