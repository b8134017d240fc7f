// Expected range z* of LANES rays of one pose at once: the walk of raycast.cl in every lane, with the same bits.
// requires: raycast lanes/types

// Return the distances in cells to the first occupied cell along LANES rays of one pose inside the grid. A lane that
// has ended reads the first cell of the table's ring, which is 0.
lanes cast_ray_lanes(global const entry *map_table, const Window window, const int2 cell, const real4 pose,
                     const lanes ray_x, const lanes ray_y, const real limit) {
    lanes dx = pose.z * ray_x - pose.w * ray_y, dy = pose.w * ray_x + pose.z * ray_y;
    dx = fabs(dx) < TINY ? (lanes)0 : dx;
    dy = fabs(dy) < TINY ? (lanes)0 : dy;
    const ilanes right = dx >= 0, up = dy >= 0;
    const lanes speed_x = fabs(dx), speed_y = fabs(dy), inv_x = 1 / speed_x, inv_y = 1 / speed_y;
    const lanes a_x = right ? (lanes)(1 - pose.x) : (lanes)pose.x;
    const lanes a_y = up ? (lanes)(1 - pose.y) : (lanes)pose.y;
    const int size = (window.rows + 2) * (window.cols + 2);
    ilanes plane = (right ? (ilanes)0 : (ilanes)SECTORS) + (up ? (ilanes)0 : (ilanes)(2 * SECTORS));
#if SECTORS_2
    plane = speed_y > speed_x ? plane + 1 : plane;
#endif
#if SECTORS_4
    plane = speed_y > speed_x ? plane + 2 : plane;
    plane = speed_y > (speed_y > speed_x ? (lanes)2.4142136f : (lanes)0.41421356f) * speed_x ? plane + 1 : plane;
#endif
    const int stride = window.cols + 2;
    const ilanes step_x = right ? (ilanes)1 : (ilanes)-1, step_y = up ? (ilanes)stride : (ilanes)-stride;
    const ilanes origin = plane * size + padded(cell.y, cell.x, window.cols);
    lanes k_x = COUNT, k_y = COUNT, t = 0, nearest = limit;
    ilanes going = -1;
    for (;;) {
        const ilanes x = as_ilanes(k_x) - (int)FIRST, y = as_ilanes(k_y) - (int)FIRST;
        const ilanes at = going ? origin + step_x * x + step_y * y : (ilanes)0;
        const ilanes sides = GATHER(ilanes, map_table, at);
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
        const lanes a = by_x ? a_y : a_x, inv = by_x ? inv_y : inv_x;
        const lanes place = (t * (by_x ? speed_y : speed_x) - a) + COUNT;
        const lanes count = place > COUNT ? place : (lanes)COUNT, here = ((count - COUNT) + a) * inv;
        const ilanes more = (here < t) | (~by_x & (here == t));
        const lanes aside = more ? count + 1 : count;
        k_x = by_x ? end_x : aside;
        k_y = by_x ? aside : end_y;
    }
}

// Load cosines and sines of the LANES rays from index first on. The last ray stands in for those beyond it.
void load_ray_lanes(global const real2 *ray, const int first, const int rays, lanes *x, lanes *y) {
    if (first + LANES <= rays) {
        const lanes low = load_lanes(0, (global const real *)(ray + first));
        const lanes high = load_lanes(1, (global const real *)(ray + first));
        *x = (lanes)(low.even, high.even);
        *y = (lanes)(low.odd, high.odd);
        return;
    }
    float these_x[LANES], these_y[LANES];
    for (int i = 0; i < LANES; ++i) {
        const real2 one = ray[min(first + i, rays - 1)];
        these_x[i] = one.x, these_y[i] = one.y;
    }
    *x = load_lanes(0, these_x);
    *y = load_lanes(0, these_y);
}

// Return the expected ranges of LANES rays in metres, of origins outside the grid as well.
lanes expected_range_lanes(global const entry *map_table, const Window window, const int2 cell, const real4 pose,
                           const lanes ray_x, const lanes ray_y, const RangeScale scale) {
    lanes t;
#if ORIGINS_OUTSIDE
    if (off_grid(cell.x, cell.y, window.rows, window.cols)) {
        float x[LANES], y[LANES], one[LANES];
        store_lanes(ray_x, 0, x);
        store_lanes(ray_y, 0, y);
        for (int i = 0; i < LANES; ++i)
            one[i] = cast_ray(map_table, window, cell, pose, (real2)(x[i], y[i]), scale.limit, (Caster){0, 0, 0});
        t = load_lanes(0, one);
    } else
#endif
        t = cast_ray_lanes(map_table, window, cell, pose, ray_x, ray_y, scale.limit);
    const lanes range = t * scale.resolution;
    return t >= scale.limit || range > scale.range_max ? (lanes)scale.range_max : range;
}
