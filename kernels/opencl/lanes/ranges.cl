// Expected ranges of poses and bearings, LANES rays at once: cast_ranges of ranges.cl.
// requires: lanes/ahead lanes/caster lanes/rays shapes

// Rays of a work-item, whatever the precision.
#define WORK_RAYS 16

// Cast rays: one work-item takes a particle and WORK_RAYS rays.
kernel void cast_ranges(ARGUMENTS) {
    const int begin = WORK_RAYS * get_global_id(0), n = get_global_id(1);
    if (begin >= rays || n >= particles) return;
    Lines ahead = {0, 0};
#if WORLDS
    const Window seen = world_window(world, n);
    ahead = next_table(map_table, world, n, particles, begin / WORK_RAYS, (rays + WORK_RAYS - 1) / WORK_RAYS, rays);
    map_table += world_begin(world, n, PLANES);
#else
    const Window seen = window;
#endif
    for (int first = begin; first < begin + WORK_RAYS && first < rays; first += LANES) {
        lanes x, y;
        load_ray_lanes(ray, first, rays, 1, &x, &y);
        global real *out = ranges + (long)n * rays + first;
        real single[LANES];
#if SHAPES
        for (int i = 0; i < LANES; ++i) single[i] = out[min(i, rays - 1 - first)];
        const lanes limit = load_lanes(0, single);
#else
        const lanes limit = scale.limit;
#endif
        const lanes t = cast_ray_lanes(map_table, seen, pose_cell[n], pose[n], x, y, limit, caster, &ahead);
        const lanes range = expected_range_lanes(t, scale);
        if (first + LANES <= rays) {
            store_lanes(range, 0, out);
        } else {
            store_lanes(range, 0, single);
            for (int i = 0; first + i < rays; ++i) out[i] = single[i];
        }
    }
    while (ahead.next < ahead.end) fetch_lines(&ahead, STEP_LINES);
}
