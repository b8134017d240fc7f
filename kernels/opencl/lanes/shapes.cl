// Moving shapes along LANES rays of one pose at once: shapes.cl in lanes.
// requires: shapes lanes/rays lanes/error_free

#if SHAPES
// in lanes: turned meet_disc meet_box meet_segment

LanePair nearest_shape_lanes(global const real *shapes, global const int2 *world, const Crowd crowd, const int n,
                             const int2 cell, const real4 pose, const lanes ray_x, const lanes ray_y, const lanes t) {
    lanes dx, dy;
    direct_lanes(pose, ray_x, ray_y, &dx, &dy);
    global const real *first = shapes + (long)world[2 * n + 1].x * crowd.stride;
    lane_int sight[LANES];
    store_lanes(to_ilanes(turned_lanes(dx, dy) * (SIGHTS / 4)), 0, sight);
    int at[LANES];
    for (int i = 0; i < LANES; ++i) at[i] = sight_at(crowd, n, (int)sight[i]);
    LanePair nearest = {t, 2};
    for (int k = 0; k < 2 * crowd.pairs; ++k) {
        uint left = 0;
        for (int i = 0; i < LANES; ++i) left |= (uint)((global const int *)(world + at[i]))[k];
        for (; left != 0; left &= left - 1) {
            const int i = 32 * k + lowest_bit(left);
            global const real *one = first + shape_at(crowd, i);
            const real x = (one[0] - cell.x) - pose.x, y = (one[1] - cell.y) - pose.y;
            LanePair met;
            if (i < crowd.discs) {
                met = meet_disc_lanes(dx, dy, x, y, one[2]);
            } else if (i < crowd.discs + crowd.boxes) {
                met = meet_box_lanes(dx, dy, x, y, one[2], one[3], one[4], one[5]);
            } else {
                const real end_x = (one[2] - cell.x) - pose.x, end_y = (one[3] - cell.y) - pose.y;
                met = meet_segment_lanes(dx, dy, x, y, end_x, end_y);
            }
            const ilanes nearer = met.x < nearest.x;
            nearest.x = nearer ? met.x : nearest.x;
            nearest.y = nearer ? met.y : nearest.y;
        }
    }
    return nearest;
}
#endif
