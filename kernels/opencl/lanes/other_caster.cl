// Casters without a body in lanes: each ray by itself.
// requires: lanes/each_ray

// Return the distances in cells to the first occupied cells along LANES rays of one pose, limits where none is nearer.
lanes cast_ray_lanes(global const entry *map_table, const Window window, const int2 cell, const real4 pose,
                     const lanes ray_x, const lanes ray_y, const lanes limit, const Caster caster, Lines *ahead) {
    return cast_each_ray(map_table, window, cell, pose, ray_x, ray_y, limit, caster);
}
