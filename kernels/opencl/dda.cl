// Expected range by the plain walk of Amanatides and Woo (1987), cell by cell. It is exact, with the same bits as the
// exact caster. The table holds 1 for occupied cells in a ring of twos.
// requires: rectangles ray

typedef uchar entry;

// Return the distance in cells to the first occupied cell, limit where none is nearer.
real cast_ray(global const entry *map_table, const Window window, const int2 cell, const real4 pose, const real2 ray,
              const real limit, const Caster caster) {
    const Ray r = make_ray(pose, ray);
#if OUTSIDE_OCCUPIED
#if ORIGINS_OUTSIDE
    if (off_grid(cell.x, cell.y, window.rows, window.cols)) return 0;
#endif
#endif
    const Walk start = start_walk(r, cell, window, limit);
    int k_x = start.k_x, k_y = start.k_y;
    real t = start.t;
    if (t >= limit) return limit;
    int state = map_table[padded(cell.y + r.step_y * k_y, cell.x + r.step_x * k_x, window.cols)];
    // A step beyond limit still ends in the table. Several exits of the loop give wrong ranges on Mesa's llvmpipe.
    while (state == 0 && t < limit) {
        const real t_x = ((real)k_x + r.a_x) * r.inv_x;
        const real t_y = ((real)k_y + r.a_y) * r.inv_y;
        const int by_x = t_x <= t_y;
        t = by_x ? t_x : t_y;
        k_x += by_x;
        k_y += !by_x;
        state = map_table[padded(cell.y + r.step_y * k_y, cell.x + r.step_x * k_x, window.cols)];
    }
#if OUTSIDE_OCCUPIED
    return t < limit ? t : limit;
#else
    return t < limit && state == 1 ? t : limit;
#endif
}
