// Expected ranges of LANES rays of one pose by a look-up table: lookup.cl in lanes, with the same bits.
// requires: lookup lanes/rays lanes/each_ray

// Return directions as parts of a full turn in [0, 1].
lanes turn_of_lanes(const lanes dx, const lanes dy) {
    const lanes x = fabs(dx), y = fabs(dy);
    const lanes a = x > y ? y / x : x / y, s = a * a;
    const lanes tail = (real)0.02867033 + s * ((real)-0.01354934 + s * (real)0.00331601);
    const lanes eighth = a * ((real)0.15913362 + s * ((real)-0.05256880 + s * tail));
    const lanes quarter = x > y ? eighth : (real)0.25 - eighth;
    const lanes upper = dx >= 0 ? quarter : (real)0.5 - quarter;
    return dy >= 0 ? upper : (real)1 - upper;
}

// Return the distances in cells from the table, limit where no obstacle is nearer; limit is the table's in every lane.
lanes cast_ray_lanes(global const entry *map_table, const Window window, const int2 cell, const real4 pose,
                     const lanes ray_x, const lanes ray_y, const lanes limit, const Caster caster) {
#if ORIGINS_OUTSIDE
    if (off_grid(cell.x, cell.y, window.rows, window.cols))
        return cast_each_ray(map_table, window, cell, pose, ray_x, ray_y, limit, caster);
#endif
    lanes dx, dy;
    direct_lanes(pose, ray_x, ray_y, &dx, &dy);
    const ilanes nearest = to_ilanes(turn_of_lanes(dx, dy) * (real)caster.bins + (real)0.5);
    const ilanes bin = nearest >= caster.bins ? nearest - caster.bins : nearest;
    global const entry *here = map_table + ((long)cell.y * window.cols + cell.x) * caster.bins;
    const ilanes part = GATHER(ilanes, here, bin);
    const lanes t = to_lanes(part) * (limit / (real)65535);
    return ((part == 65535) | (t >= limit)) ? limit : t;
}
