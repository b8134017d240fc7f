// Expected range z*: distance from a beam's origin to the first occupied cell, exactly (book section 6.3).
// An Amanatides-Woo walk that crosses a whole empty square at a time and visits the same cells: crossing distances are
// (k + a) * inv with an integer count k, never accumulated, and ties (corners) step in x first.
// Casts and comparisons stand where floor, ceil, fmin and fmax would do: some drivers call those as functions.
// requires: squares

// Smallest direction component that is told from zero: its inverse must be finite.
#define TINY ((real)1e-30)

// Unit direction of a ray in the grid's frame: pose (frac x, frac y, cos, sin) turned by the beam's (cos, sin).
real2 ray_direction(const real4 pose, const real2 ray) {
    const real dx = pose.z * ray.x - pose.w * ray.y;
    const real dy = pose.w * ray.x + pose.z * ray.y;
    return (real2)(fabs(dx) < TINY ? (real)0 : dx, fabs(dy) < TINY ? (real)0 : dy);
}

// Number of boundaries k = 0, 1, ... whose distance (k + a) * inv is below t. The guess is off by one at most.
int crossed_before(const real t, const real speed, const real a, const real inv) {
    const real place = t * speed - a;
    const int whole = (int)place;
    const int above = whole + ((real)whole < place);
    const int guess = above < 0 ? 0 : above;
    if (((real)guess + a) * inv < t) return guess + 1;
    if (guess > 0 && ((real)(guess - 1) + a) * inv >= t) return guess - 1;
    return guess;
}

// The same, those at t included.
int crossed_until(const real t, const real speed, const real a, const real inv) {
    const real place = t * speed - a;
    const int whole = (int)place;
    const int guess = whole - ((real)whole > place) + 1;
    if (((real)guess + a) * inv <= t) return guess + 1;
    if (guess > 0 && ((real)(guess - 1) + a) * inv > t) return guess - 1;
    return guess;
}

// Distance in cells to the first occupied cell, or limit where there is none nearer.
real cast_ray(global const uchar *squares, const int rows, const int cols, const int2 cell, const real4 pose,
              const real2 ray, const real limit) {
    const real2 direction = ray_direction(pose, ray);
    const int right = direction.x >= 0, up = direction.y >= 0;
    const real speed_x = fabs(direction.x), speed_y = fabs(direction.y);
    const real inv_x = (real)1 / speed_x, inv_y = (real)1 / speed_y;
    const real a_x = right ? (real)1 - pose.x : pose.x, a_y = up ? (real)1 - pose.y : pose.y;
    const int step_x = right ? 1 : -1, step_y = up ? 1 : -1;
    const int plane = ((right ? 0 : 1) + (up ? 0 : 2)) * (rows + 2) * (cols + 2);
    int k_x = 0, k_y = 0;
    real t = 0;
#if ORIGINS_OUTSIDE
    if (cell.x < 0 || cell.x >= cols || cell.y < 0 || cell.y >= rows) {
#if OUTSIDE_OCCUPIED
        return 0;
#else
        const int enter_x = max(right ? -cell.x : cell.x - (cols - 1), 0);
        const int enter_y = max(up ? -cell.y : cell.y - (rows - 1), 0);
        const real enter_t_x = enter_x > 0 ? ((real)(enter_x - 1) + a_x) * inv_x : (real)-1;
        const real enter_t_y = enter_y > 0 ? ((real)(enter_y - 1) + a_y) * inv_y : (real)-1;
        t = enter_t_x > enter_t_y ? enter_t_x : enter_t_y;
        if (!(t >= 0 && t < limit)) return limit;
        if (enter_t_x > enter_t_y) {
            k_x = enter_x;
            k_y = crossed_before(t, speed_y, a_y, inv_y);
        } else {
            k_y = enter_y;
            k_x = crossed_until(t, speed_x, a_x, inv_x);
        }
        const int col = cell.x + step_x * k_x, row = cell.y + step_y * k_y;
        if (col < 0 || col >= cols || row < 0 || row >= rows) return limit;
#endif
    }
#endif
    for (;;) {
        const int col = cell.x + step_x * k_x, row = cell.y + step_y * k_y;
        const int side = squares[plane + padded(row, col, cols)];
        if (side == 0) {
#if OUTSIDE_OCCUPIED
            return t;
#else
            return col < 0 || col >= cols || row < 0 || row >= rows ? limit : t;
#endif
        }
        const real t_x = ((real)(k_x + side - 1) + a_x) * inv_x;
        const real t_y = ((real)(k_y + side - 1) + a_y) * inv_y;
        t = t_x <= t_y ? t_x : t_y;
        if (t >= limit) return limit;
        if (t_x <= t_y) {
            k_x += side;
            k_y = crossed_before(t, speed_y, a_y, inv_y);
        } else {
            k_y += side;
            k_x = crossed_until(t, speed_x, a_x, inv_x);
        }
    }
}

// Metres from cells: exactly range_max where nothing is nearer.
real expected_range(const real t, const real limit, const real resolution, const real range_max) {
    const real range = t * resolution;
    return t >= limit || range > range_max ? range_max : range;
}

// One work-item a particle and ray: the expected ranges themselves.
kernel void cast_ranges(global const uchar *squares, global const int2 *pose_cell, global const real4 *pose,
                        global const real2 *ray, global real *ranges, const int rows, const int cols,
                        const int particles, const int rays, const real limit, const real resolution,
                        const real range_max) {
    const int k = get_global_id(0), n = get_global_id(1);
    if (k >= rays || n >= particles) return;
    const real t = cast_ray(squares, rows, cols, pose_cell[n], pose[n], ray[k], limit);
    ranges[(long)n * rays + k] = expected_range(t, limit, resolution, range_max);
}
