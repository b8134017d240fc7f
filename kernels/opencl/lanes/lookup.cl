// Expected ranges of LANES rays of one pose by a look-up table: lookup.cl in lanes, with the same bits.
// requires: lookup lanes/rays lanes/each_ray

// Return the distances in cells from the table, limit where no obstacle is nearer; limit is the table's in every lane.
lanes cast_ray_lanes(global const entry *map_table, const Window window, const int2 cell, const real4 pose,
                     const lanes ray_x, const lanes ray_y, const lanes limit, const Caster caster, Lines *ahead) {
#if ORIGINS_OUTSIDE
    if (off_grid(cell.x, cell.y, window.rows, window.cols))
        return cast_each_ray(map_table, window, cell, pose, ray_x, ray_y, limit, caster);
#endif
    lanes dx, dy;
    direct_lanes(pose, ray_x, ray_y, &dx, &dy);
    const ilanes bin = angle_bin_lanes(dx, dy, caster.bins);
    global const entry *here = map_table + ((long)cell.y * window.cols + cell.x) * caster.bins;
    const ilanes part = GATHER(ilanes, here, bin);
    const real unit = limit.s0 / (real)65535;
    const lanes t = to_lanes(part) * unit;
    return ((part == 65535) | (t >= limit)) ? limit : t;
}
