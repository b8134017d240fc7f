// Expected range by Bresenham's line (1965) from the origin's cell to the cell at the ray's end; see the reference.
// requires: rectangles ray

typedef uchar entry;

// The entry of the ring where a line meets nothing outside the grid; cells at which lines end have 0.
#define EDGE 255

// Return the distance in cells from the origin's cell to the first occupied cell of the line, limit without one.
real cast_ray(global const entry *map_table, const Window window, const int2 cell, const real4 pose, const real2 ray,
              const real limit, const Caster caster) {
    const Ray r = make_ray(pose, ray);
#if ORIGINS_OUTSIDE
    if (off_grid(cell.x, cell.y, window.rows, window.cols)) {
#if OUTSIDE_OCCUPIED
        return 0;
#endif
#if BELUGA_LINES
        return limit;
#endif
    }
#endif
    const Walk start = start_walk(r, cell, window, limit);
    if (start.t >= limit) return limit;
    const int col = cell.x + r.step_x * start.k_x, row = cell.y + r.step_y * start.k_y;
    const int end_col = cell.x + floor_int(pose.x + limit * r.direction.x);
    const int end_row = cell.y + floor_int(pose.y + limit * r.direction.y);
    const int far_x = abs(end_col - col), far_y = abs(end_row - row), far = max(far_x, far_y);
    // A line of a single cell goes on diagonally.
    const int longer = max(far, 1), shorter = far == 0 ? 1 : min(far_x, far_y);
    const int right = end_col > col ? 1 : -1, up = end_row > row ? 1 : -1;
#if AMCL_LINES
    const int last = far + 1;
#else
    const int last = far;
#endif
    int along = 0, aside = 0, x = 0, y = 0, steps = map_table[padded(row, col, window.cols)];
#if BELUGA_LINES
    int rest = longer - 1;
#else
    int rest = longer;
#endif
    // A leap beyond the line's end still ends in the table. Ranges are at most 2^20 cells, so sums stay below 2^31.
    while (steps != 0 && steps != EDGE && along <= last) {
        along += steps;
        rest += 2 * shorter * steps;
        aside += rest / (2 * longer);
        rest %= 2 * longer;
        x = far_x >= far_y ? along : aside, y = far_x >= far_y ? aside : along;
        steps = map_table[padded(row + up * y, col + right * x, window.cols)];
    }
    return steps == 0 && along <= last ? start.t + sqrt((real)x * (real)x + (real)y * (real)y) : limit;
}
