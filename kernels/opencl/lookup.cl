// Expected range by a look-up table over cells and angle bins (precomputed ranges, book section 6.3):
// for each cell and bin the range from the cell's centre in the bin's direction, in units of limit / 65 535.
// requires: ray

typedef ushort entry;

// Return the distance in cells from the table, limit where no obstacle is nearer.
real cast_ray(global const entry *map_table, const Window window, const int2 cell, const real4 pose, const real2 ray,
              const real limit, const Caster caster) {
    int col = cell.x, row = cell.y;
    const Ray r = make_ray(pose, ray);
    real t = 0;
#if ORIGINS_OUTSIDE
    if (off_grid(cell.x, cell.y, window.rows, window.cols)) {
#if OUTSIDE_OCCUPIED
        return 0;
#else
        const Walk start = start_walk(r, cell, window, limit);
        if (start.t >= limit) return limit;
        t = start.t;
        col += r.step_x * start.k_x;
        row += r.step_y * start.k_y;
#endif
    }
#endif
    const int part = map_table[((long)row * window.cols + col) * caster.bins + angle_bin(r.direction, caster.bins)];
    if (part == 65535) return limit;
    t += (real)part * (limit / (real)65535);
    return t < limit ? t : limit;
}
