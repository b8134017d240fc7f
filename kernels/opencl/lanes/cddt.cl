// Expected ranges of LANES rays of one pose by a compressed directional distance transform: cddt.cl in lanes, with the
// same bits. All lanes halve their lines together.
// requires: cddt lanes/rays

// Return the distances in cells to the first obstacles of the lines, limits where none is nearer.
lanes cast_ray_lanes(global const entry *map_table, const Window window, const int2 cell, const real4 pose,
                     const lanes ray_x, const lanes ray_y, const lanes limit, const Caster caster, Lines *ahead) {
    const int lines = map_table[0];
    global const entry *bin_first = map_table + 1, *first = bin_first + 3 * caster.bins;
    global const entry *bits = first + caster.bins * lines + 1;
    if (off_grid(cell.x, cell.y, window.rows, window.cols)) {
#if OUTSIDE_OCCUPIED
        return (lanes)0;
#endif
    } else {
        const int index = cell.y * window.cols + cell.x;
        if ((uint)bits[index / 32] >> (index % 32) & 1u) return (lanes)0;
    }
    lanes dx, dy;
    direct_lanes(pose, ray_x, ray_y, &dx, &dy);
    const ilanes bin = angle_bin_lanes(dx, dy, caster.bins), place = 3 * bin;
    global const entry *bin_second = bin_first + 1, *bin_third = bin_first + 2;
    const lanes c = GATHER(lanes, bin_first, place) * (real)9.31322574615478515625e-10;
    const lanes s = GATHER(lanes, bin_second, place) * (real)9.31322574615478515625e-10;
    const real x = (real)cell.x + pose.x, y = (real)cell.y + pose.y;
    const lanes along = c * x + s * y, across = c * y - s * x;
    const ilanes inside = (across <= FARTHEST) & (across >= -FARTHEST);
    const ilanes line = floor_int_lanes(inside ? across : (lanes)0) - GATHER(ilanes, bin_third, place);
    const ilanes valid = inside & (line >= 0) & (line < lines);
    if (!any_lane(valid)) return limit;
    lanes from_real = along > FARTHEST ? (lanes)FARTHEST : along;
    from_real = (from_real < -FARTHEST ? (lanes)-FARTHEST : from_real) * ENTRY_UNIT;
    const ilanes floored = floor_int_lanes(from_real);
    // Truncate.
    const ilanes from = floored - ((from_real < 0) & (to_lanes(floored) != from_real));
    const ilanes at = valid ? bin * lines + line : (ilanes)0;
    global const entry *next = first + 1;
    ilanes low = GATHER(ilanes, first, at);
    const ilanes end = GATHER(ilanes, next, at);
    ilanes high = end, open = valid & (low < high);
    const ilanes none = ~valid | (low == high);
    while (any_lane(open)) {
        const ilanes middle = open ? low + ((high - low) >> 1) : (ilanes)0;
        const ilanes below = GATHER(ilanes, map_table, middle) < from;
        low = (open & below) ? middle + 1 : low;
        high = (open & ~below) ? middle : high;
        open = valid & (low < high);
    }
    const ilanes found = ~none & (low < end);
    if (!any_lane(found)) return limit;
    const ilanes place_of = found ? low : (ilanes)0;
    const lanes t = GATHER(lanes, map_table, place_of) / ENTRY_UNIT - along;
    const lanes nearest = t < 0 ? (lanes)0 : t < limit ? t : limit;
    return found ? nearest : limit;
}
