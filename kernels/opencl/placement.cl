// Placement of poses in a window of the grid, in float64: an integer cell, the fraction of it, and the heading. Only +, -, *,
// /, floor and comparisons are used, so that every device gives the same bits.
// requires: heading

#if POSES_FLOAT32
typedef float coordinate;
#else
typedef double coordinate;
#endif

// Coordinates are clamped to this many cells: no range reaches as far, and sums of two stay within int32.
#define FARTHEST 1073741824.0
#if FLOAT64
#define BELOW_ONE 0x1.fffffffffffffp-1
#else
#define BELOW_ONE 0x1.fffffep-1f
#endif

// Clamp a coordinate to +-FARTHEST cells; NaN, as after an overflow, becomes -FARTHEST.
double within_reach(const double position) {
    const double above = position > -FARTHEST ? position : -FARTHEST;
    return above < FARTHEST ? above : FARTHEST;
}

// Return the floor of a coordinate, 0 for -0; some drivers call floor as a function.
double floor_cells(const double position) {
    const double whole = (double)(int)position;
    return whole > position ? whole - 1.0 : whole;
}

// Place a sensor: a pose times the scanner's mount, without its yaw, which belongs to the bearings. pose_low gets the
// rounding errors (low parts) of pose. verdict, which the caller clears, becomes 1 at (0) if a pose is not finite, and
// at (1) if a sensor is outside the window. A pose that is not finite becomes the farthest cell, fraction 0 and heading
// (1, 0): it sees nothing, and its indices stay in bounds.
void place_pose(const int particle, global const coordinate *poses, global int2 *pose_cell, global real4 *pose,
                global real4 *pose_low, global int *verdict, const double origin_x, const double origin_y,
                const double resolution, const double mount_x, const double mount_y, const double yaw_cos,
                const double yaw_sin, const int first_col, const int first_row, const int rows, const int cols) {
    const long first = 3 * (long)particle;
    double x = poses[first], y = poses[first + 1];
    const double theta = poses[first + 2];
    const int finite = (x - x) + (y - y) + (theta - theta) == 0;
    const double2 heading = cos_sin(theta);
    double cosine = heading.x, sine = heading.y;
    x -= origin_x;
    y -= origin_y;
    if (mount_x != 0 || mount_y != 0) {
        x += cosine * mount_x - sine * mount_y;
        y += sine * mount_x + cosine * mount_y;
    }
    if (yaw_sin != 0) {
        const double x_before = x, cosine_before = cosine;
        x = yaw_cos * x + yaw_sin * y;
        y = yaw_cos * y - yaw_sin * x_before;
        cosine = cosine * yaw_cos + sine * yaw_sin;
        sine = sine * yaw_cos - cosine_before * yaw_sin;
    }
    x = within_reach(x / resolution);
    y = within_reach(y / resolution);
    if (!finite) {
        atomic_or(&verdict[0], 1);
        x = y = -FARTHEST;
        cosine = 1, sine = 0;
    }
    const double whole_x = floor_cells(x), whole_y = floor_cells(y);
    const int2 cell = (int2)((int)whole_x - first_col, (int)whole_y - first_row);
    if (cell.x < 0 || cell.y < 0 || cell.x >= cols || cell.y >= rows) atomic_or(&verdict[1], 1);
    pose_cell[particle] = cell;
    // Adding 0 turns -0 into 0.
    x = (x - whole_x) + 0.0;
    y = (y - whole_y) + 0.0;
    // A fraction just below 1 may round to 1, which would be the next cell.
    real rounded_x = (real)x, rounded_y = (real)y;
    rounded_x = rounded_x < BELOW_ONE ? rounded_x : BELOW_ONE;
    rounded_y = rounded_y < BELOW_ONE ? rounded_y : BELOW_ONE;
    const real4 rounded = (real4)(rounded_x, rounded_y, (real)cosine, (real)sine);
    pose[particle] = rounded;
#if CAREFUL
    pose_low[particle] = (real4)((real)(x - rounded.x), (real)(y - rounded.y), (real)(cosine - rounded.z),
                                 (real)(sine - rounded.w));
#endif
}

// Place poses: one work-item takes a particle.
kernel void place_poses(global const coordinate *poses, global int2 *pose_cell, global real4 *pose,
                        global real4 *pose_low, global int *verdict, const double origin_x, const double origin_y,
                        const double resolution, const double mount_x, const double mount_y, const double yaw_cos,
                        const double yaw_sin, const int first_col, const int first_row, const int rows, const int cols,
                        const int particles) {
    const int particle = get_global_id(0);
    if (particle >= particles) return;
    place_pose(particle, poses, pose_cell, pose, pose_low, verdict, origin_x, origin_y, resolution, mount_x, mount_y,
               yaw_cos, yaw_sin, first_col, first_row, rows, cols);
}
