// Placement of poses in a window of the grid, in float64: an integer cell, the fraction of it, and the heading. Only +,
// -, *, /, floor and comparisons are used, so that every device gives the same bits.
// requires: heading

// Coordinates are clamped to this many cells: no range reaches so far, and the sum of two fits int32.
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

// Move a robot's pose in the world to its sensor's on the map, in cells; the heading is its cosine and sine.
void move_to_sensor(const Frame frame, double *to_x, double *to_y, double *to_cosine, double *to_sine) {
    double x = *to_x - frame.origin_x, y = *to_y - frame.origin_y, cosine = *to_cosine, sine = *to_sine;
    if (frame.mount_x != 0 || frame.mount_y != 0) {
        x += cosine * frame.mount_x - sine * frame.mount_y;
        y += sine * frame.mount_x + cosine * frame.mount_y;
    }
    if (frame.yaw_sin != 0) {
        const double x_before = x, cosine_before = cosine;
        x = frame.yaw_cos * x + frame.yaw_sin * y;
        y = frame.yaw_cos * y - frame.yaw_sin * x_before;
        cosine = cosine * frame.yaw_cos + sine * frame.yaw_sin;
        sine = sine * frame.yaw_cos - cosine_before * frame.yaw_sin;
    }
    *to_x = within_reach(x / frame.resolution), *to_y = within_reach(y / frame.resolution);
    *to_cosine = cosine, *to_sine = sine;
}

// Place a sensor: a pose times the scanner's mount, without its yaw, which belongs to the bearings. pose_low gets the
// rounding errors (low parts) of pose. pose_status, which the caller clears, becomes 1 at index 0 if a pose is not
// finite, and at index 1 if a sensor is outside the window. A non-finite pose becomes the farthest cell, fraction 0 and
// heading (1, 0): it sees nothing, and its indices stay in bounds.
void place_pose(const int particle, global const coordinate *poses, global int2 *pose_cell, global real4 *pose,
                global real4 *pose_low, global int *pose_status, const Frame frame, const Window window) {
    const long first = 3 * (long)particle;
    double x = poses[first], y = poses[first + 1];
    const double theta = poses[first + 2];
    const int finite = (x - x) + (y - y) + (theta - theta) == 0;
    const double2 heading = cos_sin(theta);
    double cosine = heading.x, sine = heading.y;
    move_to_sensor(frame, &x, &y, &cosine, &sine);
    if (!finite) {
        atomic_or(&pose_status[0], 1);
        x = y = -FARTHEST;
        cosine = 1, sine = 0;
    }
    const double whole_x = floor_cells(x), whole_y = floor_cells(y);
    const int2 cell = (int2)((int)whole_x - window.col, (int)whole_y - window.row);
    if (cell.x < 0 || cell.y < 0 || cell.x >= window.cols || cell.y >= window.rows) atomic_or(&pose_status[1], 1);
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
#if TWO_PART_POINTS
    pose_low[particle] = (real4)((real)(x - rounded.x), (real)(y - rounded.y), (real)(cosine - rounded.z),
                                 (real)(sine - rounded.w));
#endif
}

// Numbers of a world's frame: x and y of its origin, cosine and sine of its yaw, rows, columns, its first cell, and one
// that is not used.
#define FRAME_NUMBERS 8

// Return the frame of a world; all worlds share the scanner's position and the resolution.
Frame frame_in(global const double *frames, const int index, const Frame frame) {
    global const double *numbers = frames + (long)index * FRAME_NUMBERS;
    Frame moved = frame;
    moved.origin_x = numbers[0], moved.origin_y = numbers[1];
    moved.yaw_cos = numbers[2], moved.yaw_sin = numbers[3];
    return moved;
}

// Place poses: one work-item takes a particle.
kernel void place_poses(ARGUMENTS) {
    const int particle = get_global_id(0);
    if (particle >= particles) return;
    place_pose(particle, poses, pose_cell, pose, pose_low, pose_status, frame, window);
}

// Write the least of some numbers, and the largest of the numbers that lie apart from them; NaN remains. One work-item
// takes every items-th number; items is a multiple of three, so that each sees one column of poses. A first launch bounds
// the poses, and a second one the results of the first, which fill two halves.
kernel void bound_numbers(ARGUMENTS) {
    const int i = get_global_id(0);
    if (i >= items) return;
    double low = INFINITY, high = -INFINITY;
    for (long n = i; n < count; n += items) {
        const double a = number[n], b = number[apart + n];
        low = a < low || a != a ? a : low;
        high = b > high || b != b ? b : high;
    }
    bounds[i] = low;
    bounds[items + i] = high;
}
