// Expected ranges of LANES rays of one pose by marching through the distance field: march.cl in lanes, with the same
// bits.
// requires: march lanes/rays lanes/each_ray

// Return the distances in cells to points in occupied cells, limits where none is nearer. A lane that has ended reads
// the first cell.
lanes cast_ray_lanes(global const entry *map_table, const Window window, const int2 cell, const real4 pose,
                     const lanes ray_x, const lanes ray_y, const lanes limit, const Caster caster, Lines *ahead) {
#if ORIGINS_OUTSIDE
    if (off_grid(cell.x, cell.y, window.rows, window.cols))
        return cast_each_ray(map_table, window, cell, pose, ray_x, ray_y, limit, caster);
#endif
    lanes dx, dy, t = 0, found = limit;
    direct_lanes(pose, ray_x, ray_y, &dx, &dy);
    ilanes going = t < limit;
    while (any_lane(going)) {
        const ilanes col = cell.x + floor_int_lanes(pose.x + t * dx);
        const ilanes row = cell.y + floor_int_lanes(pose.y + t * dy);
        const ilanes off = (col < 0) | (col >= window.cols) | (row < 0) | (row >= window.rows);
#if OUTSIDE_OCCUPIED
        found = (going & off) ? t : found;
#endif
        going &= ~off;
        const ilanes at = going ? row * window.cols + col : (ilanes)0;
        const lanes distance = GATHER(lanes, map_table, at);
        const ilanes hit = going & (distance == 0);
        found = hit ? t : found;
        const lanes least = caster.tolerance + t * LEAST_STEP, step = distance - caster.slack;
        t += step > least ? step : least;
        going &= ~hit & (t < limit);
    }
    return found;
}
