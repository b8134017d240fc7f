// Poses relative to a point and headings relative to an angle, in float64 as sums of two numbers, rounded at the end.
// Differences of large coordinates or of many turns are small, and small numbers keep their digits in any precision.
// requires: heading

// pair_sum of error_free.cl in float64.
double2 pair_sum_float64(const double2 a, const double2 b) {
    const double2 sum = two_sum_float64(a.x, b.x);
    return two_sum_float64(sum.x, sum.y + (a.y + b.y));
}

// Return theta - target in [-pi, pi]; the target is in that interval.
double2 wrapped_difference(const double theta, const double2 target) {
    const Turn turn = reduce_heading(theta);
    // Up to three quarters are exact: the last bits of QUARTER are 0.
    const double quarters = (double)turn.quadrant;
    double2 angle = pair_sum_float64((double2)(quarters * QUARTER, quarters * QUARTER_LOW), turn.rest);
    angle = pair_sum_float64(angle, -target);
    const double turns = angle.x > 2.0 * QUARTER ? -4.0 : angle.x < -2.0 * QUARTER ? 4.0 : 0.0;
    return pair_sum_float64(angle, (double2)(turns * QUARTER, turns * QUARTER_LOW));
}

// Round a coordinate to a sum of two numbers in the model's precision.
real2 rounded_place(const double2 at) {
    const double high = at.x > FARTHEST ? FARTHEST : at.x < -FARTHEST ? -FARTHEST : at.x;
    const double low = high == at.x ? at.y : 0.0;
    const real rounded = (real)high;
    return (real2)(rounded, (real)((high - (double)rounded) + low));
}

// Place sensors relative to an origin: x, its low part, y, its low part. One work-item takes a particle. pose_status,
// which the caller clears, becomes 1 at index 0 if a pose is not finite; its place is the origin.
kernel void place_relative(ARGUMENTS) {
    const int n = get_global_id(0);
    if (n >= particles) return;
    const long first = 3 * (long)n;
    const double pose_x = poses[first], pose_y = poses[first + 1], theta = poses[first + 2];
    if (!((pose_x - pose_x) + (pose_y - pose_y) + (theta - theta) == 0)) {
        atomic_or(&pose_status[0], 1);
        place[n] = (real4)(0, 0, 0, 0);
        return;
    }
    double2 x = two_sum_float64(pose_x, -origin_x), y = two_sum_float64(pose_y, -origin_y);
    const int near = fabs(x.x) <= FARTHEST && fabs(y.x) <= FARTHEST;
    if (near && (mount_x != 0 || mount_y != 0)) {
        const double2 heading = cos_sin(theta);
        const double2 moved_x = two_sum_float64(x.x, heading.x * mount_x - heading.y * mount_y);
        const double2 moved_y = two_sum_float64(y.x, heading.y * mount_x + heading.x * mount_y);
        x = two_sum_float64(moved_x.x, moved_x.y + x.y);
        y = two_sum_float64(moved_y.x, moved_y.y + y.y);
    }
    place[n] = (real4)(rounded_place(x), rounded_place(y));
}

// Subtract the target from headings and wrap to [-pi, pi], a sum of two numbers. One work-item takes a particle.
// pose_status is as for place_relative.
kernel void wrap_headings(ARGUMENTS) {
    const int n = get_global_id(0);
    if (n >= particles) return;
    const long first = 3 * (long)n;
    const double x = poses[first], y = poses[first + 1];
    double theta = poses[first + 2];
    if (!((x - x) + (y - y) + (theta - theta) == 0)) {
        atomic_or(&pose_status[0], 1);
        theta = 0;
    }
    const double2 angle = wrapped_difference(theta, (double2)(target, target_low));
    const real rounded = (real)angle.x;
    residual[n] = (real2)(rounded, (real)((angle.x - (double)rounded) + angle.y));
}
