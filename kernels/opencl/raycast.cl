// Expected range z*: distance from a beam's origin to the first occupied cell, exactly (book section 6.3).
// An Amanatides-Woo walk that crosses a whole empty square at a time and visits the same cells; ties (corners) step in
// x first.
// requires: squares ray

typedef uchar entry;

// Distance in cells to the first occupied cell, or limit where there is none nearer.
real cast_ray(global const entry *map_table, const int rows, const int cols, const int2 cell, const real4 pose,
              const real2 ray, const real limit, const int bins, const real slack, const real tolerance) {
    const Ray r = make_ray(pose, ray);
#if OUTSIDE_OCCUPIED
#if ORIGINS_OUTSIDE
    if (off_grid(cell.x, cell.y, rows, cols)) return 0;
#endif
#endif
    const Walk start = start_walk(r, cell, rows, cols, limit);
    int k_x = start.k_x, k_y = start.k_y;
    real t = start.t;
    if (t >= limit) return limit;
    const int plane = ((r.right ? 0 : 1) + (r.up ? 0 : 2)) * (rows + 2) * (cols + 2);
    for (;;) {
        const int col = cell.x + r.step_x * k_x, row = cell.y + r.step_y * k_y;
        const int side = map_table[plane + padded(row, col, cols)];
        if (side == 0) {
#if OUTSIDE_OCCUPIED
            return t;
#else
            return off_grid(col, row, rows, cols) ? limit : t;
#endif
        }
        const real t_x = ((real)(k_x + side - 1) + r.a_x) * r.inv_x;
        const real t_y = ((real)(k_y + side - 1) + r.a_y) * r.inv_y;
        t = t_x <= t_y ? t_x : t_y;
        if (t >= limit) return limit;
        if (t_x <= t_y) {
            k_x += side;
            k_y = crossed_before(t, r.speed_y, r.a_y, r.inv_y);
        } else {
            k_y += side;
            k_x = crossed_until(t, r.speed_x, r.a_x, r.inv_x);
        }
    }
}
