// Expected ranges of LANES rays of one pose by Bresenham's lines: bresenham.cl in lanes, with the same bits.
// requires: bresenham lanes/rays lanes/each_ray

// Return the distances in cells from the origin's cell to the first occupied cells, limits without one.
lanes cast_ray_lanes(global const entry *map_table, const Window window, const int2 cell, const real4 pose,
                     const lanes ray_x, const lanes ray_y, const lanes limit, const Caster caster, Lines *ahead) {
#if ORIGINS_OUTSIDE
    if (off_grid(cell.x, cell.y, window.rows, window.cols))
        return cast_each_ray(map_table, window, cell, pose, ray_x, ray_y, limit, caster);
#endif
    lanes dx, dy;
    direct_lanes(pose, ray_x, ray_y, &dx, &dy);
    const ilanes to_x = floor_int_lanes(pose.x + limit * dx), to_y = floor_int_lanes(pose.y + limit * dy);
    const ilanes right = to_x > 0, up = to_y > 0, far_x = right ? to_x : -to_x, far_y = up ? to_y : -to_y;
    const ilanes flat = far_x >= far_y, far = flat ? far_x : far_y;
    const ilanes longer = far == 0 ? (ilanes)1 : far, shorter = far == 0 ? (ilanes)1 : flat ? far_y : far_x;
    const int stride = window.cols + 2;
    const ilanes step_x = right ? (ilanes)1 : (ilanes)-1, step_y = up ? (ilanes)stride : (ilanes)-stride;
    const ilanes onward = flat ? step_x : step_y, sideways = flat ? step_y : step_x;
#if AMCL_LINES
    const ilanes last = far + 1;
#else
    const ilanes last = far;
#endif
#if BELUGA_LINES
    ilanes rest = longer - 1;
#else
    ilanes rest = longer;
#endif
    const ilanes whole_line = 2 * longer, slope = 2 * shorter;
    const lanes inverse = 1 / to_lanes(whole_line);
    const int origin = padded(cell.y, cell.x, window.cols);
    ilanes along = 0, aside = 0, at = origin, met = 0, going = -1;
    for (;;) {
        const ilanes steps = GATHER(ilanes, map_table, at);
        met |= going & (steps == 0);
        going &= (steps != 0) & (steps != EDGE) & (along + steps <= last);
        if (!any_lane(going)) break;
        const ilanes leap = going ? steps : (ilanes)0;
        along += leap;
        rest += slope * leap;
        // The product is off by one at most.
        ilanes more = to_ilanes(to_lanes(rest) * inverse);
        rest -= more * whole_line;
        more += (rest < 0) - (rest >= whole_line);
        rest += (rest < 0 ? whole_line : (ilanes)0) - (rest >= whole_line ? whole_line : (ilanes)0);
        aside += more;
        at = origin + along * onward + aside * sideways;
    }
    const lanes i = to_lanes(along), j = to_lanes(aside);
    return met ? sqrt(i * i + j * j) : limit;
}
