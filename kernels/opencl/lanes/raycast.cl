// Expected range z* of LANES rays of one pose at once: the walk of raycast.cl in every lane, with the same bits.
// requires: raycast lanes/ahead lanes/rays lanes/each_ray

// Lines that a step fetches.
#define STEP_LINES 4

// Return the distances in cells to the first occupied cells along LANES rays of one pose, limits where none is nearer.
// A lane that has ended reads 0, the first cell of the table's ring. Each step fetches some lines ahead.
lanes cast_ray_lanes(global const entry *map_table, const Window window, const int2 cell, const real4 pose,
                     const lanes ray_x, const lanes ray_y, const lanes limit, const Caster caster, Lines *ahead) {
#if ORIGINS_OUTSIDE
    if (off_grid(cell.x, cell.y, window.rows, window.cols))
        return cast_each_ray(map_table, window, cell, pose, ray_x, ray_y, limit, caster);
#endif
    lanes dx, dy;
    direct_lanes(pose, ray_x, ray_y, &dx, &dy);
    const ilanes right = dx >= 0, up = dy >= 0;
    const lanes speed_x = fabs(dx), speed_y = fabs(dy), inv_x = 1 / speed_x, inv_y = 1 / speed_y;
    const lanes a_x = right ? (lanes)(1 - pose.x) : (lanes)pose.x;
    const lanes a_y = up ? (lanes)(1 - pose.y) : (lanes)pose.y;
    ilanes plane = (right ? (ilanes)0 : (ilanes)SECTORS) + (up ? (ilanes)0 : (ilanes)(2 * SECTORS));
#if SECTORS_2
    plane = speed_y > speed_x ? plane + 1 : plane;
#endif
#if SECTORS_4
    plane = speed_y > speed_x ? plane + 2 : plane;
    plane = speed_y > (speed_y > speed_x ? (lanes)(real)2.4142136 : (lanes)(real)0.41421356) * speed_x ? plane + 1 : plane;
#endif
    const int stride = GROUP * (window.cols + 2), size = (window.rows + 2 + GROUP - 1) / GROUP * stride;
    const ilanes step_x = right ? (ilanes)GROUP : (ilanes)-GROUP;
#if ROW_GROUPS
    const ilanes step_y = up ? (ilanes)1 : (ilanes)-1, origin = plane * size + GROUP * (cell.x + 1);
#else
    const ilanes step_y = up ? (ilanes)stride : (ilanes)-stride;
    const ilanes origin = plane * size + padded(cell.y, cell.x, window.cols);
#endif
    lanes k_x = COUNT, k_y = COUNT, t = 0, nearest = limit;
    ilanes going = -1;
    for (;;) {
        const ilanes x = as_ilanes(k_x) - FIRST_BITS, y = as_ilanes(k_y) - FIRST_BITS;
#if ROW_GROUPS
        const ilanes row = cell.y + 1 + step_y * y;
        const ilanes at = going ? origin + step_x * x + row + (row >> GROUP_BITS) * (stride - GROUP) : (ilanes)0;
#else
        const ilanes at = going ? origin + step_x * x + step_y * y : (ilanes)0;
#endif
        const ilanes sides = GATHER(ilanes, map_table, at);
        fetch_lines(ahead, STEP_LINES);
        const ilanes stopped = going & (sides <= OCCUPIED);
        if (any_lane(stopped)) {
#if OUTSIDE_OCCUPIED
            nearest = stopped ? t : nearest;
#else
            nearest = (stopped & (sides == OCCUPIED)) ? t : nearest;
#endif
            going &= sides > OCCUPIED;
            if (!any_lane(going)) return nearest;
        }
        const lanes end_x = as_lanes(as_ilanes(k_x) + (sides & 255)), end_y = as_lanes(as_ilanes(k_y) + (sides >> 8));
        const lanes t_x = ((end_x - (COUNT + 1)) + a_x) * inv_x, t_y = ((end_y - (COUNT + 1)) + a_y) * inv_y;
        const ilanes by_x = t_x <= t_y;
        t = by_x ? t_x : t_y;
        going &= t < limit;
        if (!any_lane(going)) return nearest;
        const lanes aside = crossed_lanes(t, by_x ? speed_y : speed_x, by_x ? a_y : a_x, by_x ? inv_y : inv_x, ~by_x);
        k_x = by_x ? end_x : aside;
        k_y = by_x ? aside : end_y;
    }
}

#if WORLDS
// Particles that fetch a table together.
#define FETCHERS 16

// Return a particle's share of the lines of the next world's table, if the next FETCHERS particles begin there; ``part``
// is one of the ``parts`` of that share. No line is fetched if each particle is in another world, or if few rays are
// cast in a large world.
Lines next_table(global const entry *tables, global const int2 *world, const int n, const int particles, const int part,
                 const int parts, const int rays) {
    const int next = (n | (FETCHERS - 1)) + 1;
    const Lines none = {0, 0};
    if (next + 1 >= particles || world[2 * next].x == world[2 * n].x || world[2 * next].x != world[2 * next + 2].x)
        return none;
    const Window seen = world_window(world, next);
    const long rows = (seen.rows + 2 + GROUP - 1) / GROUP * GROUP, size = PLANES * rows * (seen.cols + 2) * sizeof(entry);
    const size_t table = (size_t)(tables + world_begin(world, next, PLANES));
    return lines_ahead(table, size, (n % FETCHERS) * parts + part, FETCHERS * parts, FETCHERS * rays);
}
#endif
