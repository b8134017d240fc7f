// Expected ranges of poses and bearings by any caster.
// requires: caster tiles

// Cast rays: one work-item takes a particle and ray.
kernel void cast_ranges(ARGUMENTS) {
    const int k = get_global_id(0), n = get_global_id(1);
    if (k >= rays || n >= particles) return;
    const real t = cast_ray(map_table, window, pose_cell[n], pose[n], ray[k], scale.limit, caster);
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
    for (int k = tile_ray(item, spread); k < rays; k += tile_step(spread)) {
        const real t = cast_ray(map_table, window, cell, sensor_pose, ray[k], scale.limit, caster);
        ranges[n * rays + k] = expected_range(t, scale);
    }
}
