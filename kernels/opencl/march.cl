// Expected range by marching through the distance field (sphere tracing); see the reference.
// requires: ray

typedef float entry;

// Smallest step relative to the distance, so that every step changes the distance.
#define LEAST_STEP ((real)2.384185791015625e-7)

// Return the distance in cells to a point in an occupied cell, limit where none is nearer.
real cast_ray(global const entry *map_table, const Window window, const int2 cell, const real4 pose, const real2 ray,
              const real limit, const Caster caster) {
    const Ray r = make_ray(pose, ray);
    real t = 0;
#if ORIGINS_OUTSIDE
    if (off_grid(cell.x, cell.y, window.rows, window.cols)) {
#if OUTSIDE_OCCUPIED
        return 0;
#else
        t = start_walk(r, cell, window, limit).t;
        t += caster.tolerance + t * LEAST_STEP;
#endif
    }
#endif
    while (t < limit) {
        const int col = cell.x + floor_int(pose.x + t * r.direction.x);
        const int row = cell.y + floor_int(pose.y + t * r.direction.y);
#if OUTSIDE_OCCUPIED
        if (off_grid(col, row, window.rows, window.cols)) return t;
#else
        if (off_grid(col, row, window.rows, window.cols)) return limit;
#endif
        const real distance = map_table[row * window.cols + col];
        if (distance == 0) return t;
        const real least = caster.tolerance + t * LEAST_STEP, step = distance - caster.slack;
        t += step > least ? step : least;
    }
    return limit;
}
