// Expected range by Bresenham's line (1965) from the origin's cell to the cell at the ray's end, as in nav2_amcl and
// Beluga. Distances are from cell centre to cell centre, and a line may pass between two cells that touch at a corner.
// The table holds 1 for occupied cells in a ring of twos. A line midway between two cells steps diagonally, with
// BELUGA_LINES straight ahead. With AMCL_LINES a line goes on for a cell beyond its end.
// requires: rectangles ray

typedef uchar entry;

// Return the distance in cells from the origin's cell to the first occupied cell of the line, limit without one.
real cast_ray(global const entry *map_table, const Window window, const int2 cell, const real4 pose, const real2 ray,
              const real limit, const Caster caster) {
    const Ray r = make_ray(pose, ray);
#if OUTSIDE_OCCUPIED
#if ORIGINS_OUTSIDE
    if (off_grid(cell.x, cell.y, window.rows, window.cols)) return 0;
#endif
#endif
#if BELUGA_LINES
#if ORIGINS_OUTSIDE
    if (off_grid(cell.x, cell.y, window.rows, window.cols)) return limit;
#endif
#endif
    const Walk start = start_walk(r, cell, window, limit);
    if (start.t >= limit) return limit;
    const int col = cell.x + r.step_x * start.k_x, row = cell.y + r.step_y * start.k_y;
    const int end_col = cell.x + floor_int(pose.x + limit * r.direction.x);
    const int end_row = cell.y + floor_int(pose.y + limit * r.direction.y);
    const int far_x = abs(end_col - col), far_y = abs(end_row - row);
    const int longer = max(far_x, far_y), shorter = min(far_x, far_y);
    const int right = end_col > col ? 1 : -1, up = end_row > row ? 1 : -1;
#if AMCL_LINES
    const int last = longer + 1;
#else
    const int last = longer;
#endif
    int aside = 0, error = 0;
    for (int along = 0; along <= last; ++along) {
        const int x = far_x >= far_y ? along : aside, y = far_x >= far_y ? aside : along;
        const int state = map_table[padded(row + up * y, col + right * x, window.cols)];
#if OUTSIDE_OCCUPIED
        if (state != 0) return start.t + sqrt((real)x * (real)x + (real)y * (real)y);
#else
        if (state == 2) return limit;
        if (state == 1) return start.t + sqrt((real)x * (real)x + (real)y * (real)y);
#endif
        error += shorter;
#if BELUGA_LINES
        const int over = 2 * error > longer;
#else
        const int over = 2 * error >= longer;
#endif
        if (over) {
            ++aside;
            error -= longer;
        }
    }
    return limit;
}
