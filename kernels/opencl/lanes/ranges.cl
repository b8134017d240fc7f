// Expected ranges of poses and bearings by the exact caster, LANES rays at once: cast_ranges of ranges.cl.
// requires: lanes/raycast

// Cast rays: one work-item takes a particle and LANES rays.
kernel void cast_ranges(global const entry *map_table, global const int2 *pose_cell, global const real4 *pose,
                        global const real2 *ray, global real *ranges, const Window window, const int particles,
                        const int rays, const Caster caster, const RangeScale scale) {
    const int first = LANES * get_global_id(0), n = get_global_id(1);
    if (first >= rays || n >= particles) return;
    lanes x, y;
    load_ray_lanes(ray, first, rays, &x, &y);
    const lanes range = expected_range_lanes(map_table, window, pose_cell[n], pose[n], x, y, scale);
    global real *out = ranges + (long)n * rays + first;
    if (first + LANES <= rays) {
        store_lanes(range, 0, out);
        return;
    }
    float single[LANES];
    store_lanes(range, 0, single);
    for (int i = 0; first + i < rays; ++i) out[i] = single[i];
}
