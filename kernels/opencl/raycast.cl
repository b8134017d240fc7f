// Expected range z*: distance from a beam's origin to the first occupied cell, exactly (book section 6.3).
// An Amanatides-Woo walk that crosses a whole empty square at a time and visits the same cells; ties (corners) step in
// x first.
// requires: lanes squares ray

typedef uchar entry;

// Distance in cells to the first occupied cell, or limit where there is none nearer.
real cast_ray(global const entry *map_table, const int rows, const int cols, const int2 cell, const real4 pose,
              const real2 ray, const real limit, const int bins, const real slack, const real tolerance) {
    const Ray r = make_ray(pose, ray);
#if OUTSIDE_OCCUPIED
#if ORIGINS_OUTSIDE
    if (off_grid(cell.x, cell.y, rows, cols)) return 0;
#endif
#endif
    const Walk start = start_walk(r, cell, rows, cols, limit);
    int k_x = start.k_x, k_y = start.k_y;
    real t = start.t;
    if (t >= limit) return limit;
    const int plane = ((r.right ? 0 : 1) + (r.up ? 0 : 2)) * (rows + 2) * (cols + 2);
    for (;;) {
        const int col = cell.x + r.step_x * k_x, row = cell.y + r.step_y * k_y;
        const int side = map_table[plane + padded(row, col, cols)];
        if (side == 0) {
#if OUTSIDE_OCCUPIED
            return t;
#else
            return off_grid(col, row, rows, cols) ? limit : t;
#endif
        }
        const real t_x = ((real)(k_x + side - 1) + r.a_x) * r.inv_x;
        const real t_y = ((real)(k_y + side - 1) + r.a_y) * r.inv_y;
        t = t_x <= t_y ? t_x : t_y;
        if (t >= limit) return limit;
        if (t_x <= t_y) {
            k_x += side;
            k_y = crossed_before(t, r.speed_y, r.a_y, r.inv_y);
        } else {
            k_y += side;
            k_x = crossed_until(t, r.speed_x, r.a_x, r.inv_x);
        }
    }
}

#if WIDE
// The same walk along LANES rays of one pose inside the grid at once; a lane that is done reads the ring's first zero.
lanes cast_rays(global const entry *map_table, const int rows, const int cols, const int2 cell, const real4 pose,
                  const lanes ray_x, const lanes ray_y, const real limit) {
    lanes dx = pose.z * ray_x - pose.w * ray_y, dy = pose.w * ray_x + pose.z * ray_y;
    dx = fabs(dx) < TINY ? (lanes)0 : dx;
    dy = fabs(dy) < TINY ? (lanes)0 : dy;
    const ilanes right = dx >= 0, up = dy >= 0;
    const lanes speed_x = fabs(dx), speed_y = fabs(dy), inv_x = 1 / speed_x, inv_y = 1 / speed_y;
    const lanes a_x = right ? (lanes)(1 - pose.x) : (lanes)pose.x;
    const lanes a_y = up ? (lanes)(1 - pose.y) : (lanes)pose.y;
    const int size = (rows + 2) * (cols + 2);
    const ilanes step_x = right ? (ilanes)1 : (ilanes)-1, step_y = up ? (ilanes)(cols + 2) : (ilanes)(-cols - 2);
    const ilanes origin = (right ? (ilanes)0 : (ilanes)size) + (up ? (ilanes)0 : (ilanes)(2 * size)) + padded(cell.y, cell.x, cols);
    ilanes k_x = 0, k_y = 0, going = -1;
    lanes t = 0, found = limit;
    for (;;) {
        const ilanes at = going ? origin + step_x * k_x + step_y * k_y : (ilanes)0;
        const ilanes side = GATHER(ilanes, map_table, at);
        const ilanes stopped = going && side == 0;
        if (any(stopped)) {
#if OUTSIDE_OCCUPIED
            found = stopped ? t : found;
#else
            const ilanes col = cell.x + (right ? k_x : -k_x), row = cell.y + (up ? k_y : -k_y);
            found = stopped && col >= 0 && col < cols && row >= 0 && row < rows ? t : found;
#endif
            going = going && side != 0;
            if (!any(going)) return found;
        }
        const lanes t_x = (to_lanes(k_x + side - 1) + a_x) * inv_x;
        const lanes t_y = (to_lanes(k_y + side - 1) + a_y) * inv_y;
        const ilanes by_x = t_x <= t_y;
        t = by_x ? t_x : t_y;
        going = going && t < limit;
        if (!any(going)) return found;
        // Boundaries of the other axis that are crossed, those at t excluded where x steps first.
        const lanes a = by_x ? a_y : a_x, inv = by_x ? inv_y : inv_x;
        const lanes place = t * (by_x ? speed_y : speed_x) - a;
        const ilanes whole = to_ilanes(place);
        const lanes back = to_lanes(whole);
        const ilanes above = whole - (back < place);
        const ilanes guess = by_x ? (above < 0 ? (ilanes)0 : above) : whole + (back > place) + 1;
        const lanes here = (to_lanes(guess) + a) * inv, before = (to_lanes(guess - 1) + a) * inv;
        const ilanes more = here < t || (!by_x && here == t);
        const ilanes fewer = guess > 0 && !more && (before > t || (by_x && before == t));
        const ilanes crossed = guess - more + fewer;
        k_x = by_x ? k_x + side : crossed;
        k_y = by_x ? crossed : k_y + side;
    }
}

// Cosines and sines of LANES rays from number first on; beyond the last one that one again.
void load_rays(global const real2 *ray, const int first, const int rays, lanes *x, lanes *y) {
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

// Expected ranges of LANES rays in metres.
lanes expected_ranges(global const entry *map_table, const int rows, const int cols, const int2 cell,
                        const real4 pose, const lanes ray_x, const lanes ray_y, const real limit,
                        const real resolution, const real range_max) {
    lanes t;
#if ORIGINS_OUTSIDE
    if (off_grid(cell.x, cell.y, rows, cols)) {
        float x[LANES], y[LANES], one[LANES];
        store_lanes(ray_x, 0, x);
        store_lanes(ray_y, 0, y);
        for (int i = 0; i < LANES; ++i)
            one[i] = cast_ray(map_table, rows, cols, cell, pose, (real2)(x[i], y[i]), limit, 0, 0, 0);
        t = load_lanes(0, one);
    } else
#endif
        t = cast_rays(map_table, rows, cols, cell, pose, ray_x, ray_y, limit);
    const lanes range = t * resolution;
    return t >= limit || range > range_max ? (lanes)range_max : range;
}
#endif
