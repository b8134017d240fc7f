// Expected ranges of poses and bearings by any caster. A walk ends at the nearest moving shape, whose
// distance stands in place of the range; see meet_shapes.
// requires: caster shapes

// Cast rays: one work-item takes a particle and ray.
kernel void cast_ranges(ARGUMENTS) {
    const int k = get_global_id(0), n = get_global_id(1);
    if (k >= rays || n >= particles) return;
#if WORLDS
    const Window seen = world_window(world, n);
    map_table += world_begin(world, n, PLANES);
#else
    const Window seen = window;
#endif
#if SHAPES
    const real limit = ranges[(long)n * rays + k];
#else
    const real limit = scale.limit;
#endif
    const real t = cast_ray(map_table, seen, pose_cell[n], pose[n], ray[k], limit, caster);
    ranges[(long)n * rays + k] = expected_range(t, scale);
}

// Cast rays in tiles of particles and rays, for GPUs. There are fewer than 2^31 ranges. With restrict the compiler need
// not read arguments again after a write.
kernel void cast_tiles(ARGUMENTS) {
    const int item = get_global_id(0), place = tile_place(item, spread);
    if (place >= particles) return;
#if ORDERED
    const int n = order[place];
#else
    const int n = place;
#endif
    const int2 cell = pose_cell[n];
    const real4 sensor_pose = pose[n];
#if WORLDS
    const Window seen = world_window(world, n);
    map_table += world_begin(world, n, PLANES);
#else
    const Window seen = window;
#endif
    for (int k = tile_ray(item, spread); k < rays; k += tile_step(spread)) {
#if SHAPES
        const real limit = ranges[n * rays + k];
#else
        const real limit = scale.limit;
#endif
        const real t = cast_ray(map_table, seen, cell, sensor_pose, ray[k], limit, caster);
        ranges[n * rays + k] = expected_range(t, scale);
    }
}
