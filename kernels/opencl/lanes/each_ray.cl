// Cast the rays of LANES beams of a pose one by one, by any caster; origins may lie outside the grid.
// requires: caster lanes/types

// Return the distances in cells to the first occupied cells, limits where none is nearer.
lanes cast_each_ray(global const entry *map_table, const Window window, const int2 cell, const real4 pose,
                    const lanes ray_x, const lanes ray_y, const lanes limit, const Caster caster) {
    real x[LANES], y[LANES], farthest[LANES], t[LANES];
    store_lanes(ray_x, 0, x);
    store_lanes(ray_y, 0, y);
    store_lanes(limit, 0, farthest);
    for (int i = 0; i < LANES; ++i)
        t[i] = cast_ray(map_table, window, cell, pose, (real2)(x[i], y[i]), farthest[i], caster);
    return load_lanes(0, t);
}
