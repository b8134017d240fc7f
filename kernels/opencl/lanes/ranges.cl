// Expected ranges of poses and bearings, LANES rays at once: cast_ranges of ranges.cl.
// requires: lanes/caster lanes/rays shapes

// Rays of a work-item, whatever the precision.
#define WORK_RAYS 16

#if WORLDS
// Particles that fetch a table together.
#define FETCHERS 16

// Return a part of the table of the world in which the next FETCHERS particles begin, so that it arrives while this
// world's rays are cast. Particles that change worlds one by one, or cast few rays in large worlds, fetch nothing.
Lines lines_ahead(global const entry *tables, global const int2 *world, const int n, const int particles,
                  const int begin, const int rays) {
    const int next = (n | (FETCHERS - 1)) + 1, items = FETCHERS * ((rays + WORK_RAYS - 1) / WORK_RAYS);
    Lines ahead = {0, 0};
    if (next + 1 >= particles || world[2 * next].x == world[2 * n].x || world[2 * next].x != world[2 * next + 2].x)
        return ahead;
    const Window seen = world_window(world, next);
    const long rows = (seen.rows + 2 + GROUP - 1) / GROUP * GROUP;
    const long lines = PLANES * rows * (seen.cols + 2) * sizeof(entry) / CACHE_LINE;
    if (lines > 2 * FETCHERS * rays) return ahead;
    const long item = (n % FETCHERS) * (items / FETCHERS) + begin / WORK_RAYS;
    const size_t table = (size_t)(tables + world_begin(world, next, PLANES));
    ahead.next = table + lines * item / items * CACHE_LINE;
    ahead.end = table + lines * (item + 1) / items * CACHE_LINE;
    return ahead;
}
#endif

// Cast rays: one work-item takes a particle and WORK_RAYS rays.
kernel void cast_ranges(ARGUMENTS) {
    const int begin = WORK_RAYS * get_global_id(0), n = get_global_id(1);
    if (n >= particles) return;
#if WORLDS
    const Window seen = world_window(world, n);
    Lines ahead = lines_ahead(map_table, world, n, particles, begin, rays);
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
#if WORLDS
        const lanes t = walk_and_fetch_lanes(map_table, seen, pose_cell[n], pose[n], x, y, limit, caster, &ahead);
#else
        const lanes t = cast_ray_lanes(map_table, seen, pose_cell[n], pose[n], x, y, limit, caster);
#endif
        const lanes range = range_lanes(t, scale);
        if (first + LANES <= rays) {
            store_lanes(range, 0, out);
        } else {
            store_lanes(range, 0, single);
            for (int i = 0; first + i < rays; ++i) out[i] = single[i];
        }
    }
#if WORLDS
    fetch_lines(&ahead, INT_MAX);
#endif
}
