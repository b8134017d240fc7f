// Nearest returns of LANES cones of one pose at once, and the cosines of their angles of incidence: echo.cl in lanes,
// with the same bits. A laser's cone is one ray.
// requires: lanes/ahead lanes/caster lanes/rays lanes/shapes

// Distances in cells, and cosines of the angles of incidence; without a return limit and 2.
typedef struct {
    lanes t, cosine;
} EchoLanes;

#if INCIDENCE
// Find the normals of cells.
void normal_at_lanes(global const real2 *normals, const Window window, const ilanes col, const ilanes row, lanes *x,
                     lanes *y) {
    global const real *first = (global const real *)normals, *second = first + 1;
    const ilanes off = (col < -1) | (col > window.cols) | (row < -1) | (row > window.rows);
    const ilanes at = off ? (ilanes)0 : 2 * ((row + 1) * (window.cols + 2) + col + 1);
#if OUTSIDE_OCCUPIED
    const lanes beyond = NAN;
#else
    const lanes beyond = 0;
#endif
    *x = off ? beyond : GATHER(lanes, first, at);
    *y = off ? beyond : GATHER(lanes, second, at);
}

void hit_normal_lanes(global const real2 *normals, const Window window, const int2 cell, const real4 pose,
                      const lanes dx, const lanes dy, const lanes t, lanes *x, lanes *y) {
    const ilanes right = dx >= 0, up = dy >= 0;
    const lanes speed_x = fabs(dx), speed_y = fabs(dy), inv_x = 1 / speed_x, inv_y = 1 / speed_y;
    const lanes a_x = right ? (lanes)(1 - pose.x) : (lanes)pose.x;
    const lanes a_y = up ? (lanes)(1 - pose.y) : (lanes)pose.y;
    const ilanes k_x = as_ilanes(crossed_lanes(t, speed_x, a_x, inv_x, (ilanes)-1)) - FIRST_BITS;
    const ilanes before = as_ilanes(crossed_lanes(t, speed_y, a_y, inv_y, (ilanes)0)) - FIRST_BITS;
    const ilanes col = right ? cell.x + k_x : cell.x - k_x;
    normal_at_lanes(normals, window, col, up ? cell.y + before : cell.y - before, x, y);
    const ilanes missed = (*x == 0) & (*y == 0);
    if (any_lane(missed)) {
        const ilanes after = as_ilanes(crossed_lanes(t, speed_y, a_y, inv_y, (ilanes)-1)) - FIRST_BITS;
        lanes other_x, other_y;
        normal_at_lanes(normals, window, col, up ? cell.y + after : cell.y - after, &other_x, &other_y);
        *x = missed ? other_x : *x;
        *y = missed ? other_y : *y;
    }
    const ilanes starts = t == 0;
    if (any_lane(starts)) {
        lanes start_x, start_y;
        normal_at_lanes(normals, window, (ilanes)cell.x, (ilanes)cell.y, &start_x, &start_y);
        const ilanes wall = starts & ((start_x != 0) | (start_y != 0));
        *x = wall ? start_x : *x;
        *y = wall ? start_y : *y;
    }
}
#endif

// Return the nearest returns of the cones from index first on, the last of count cones standing in for those beyond it.
// Nothing beyond a lane's limit counts.
EchoLanes nearest_echo_lanes(global const entry *map_table, global const real2 *normals, const Window window,
                             const int2 cell, const real4 pose, global const real2 *ray, const int first,
                             const int count, const Cone cone, const lanes limit, const Caster caster,
                             global const real *shapes, global const int2 *world, const Crowd crowd, const int n,
                             Lines *ahead) {
    lanes x, y;
#if CONES
    EchoLanes echo = {limit, 2};
    for (int i = 0; i < cone.rays; ++i) {
        load_ray_lanes(ray + i, first, count, cone.rays, &x, &y);
        // Most casters may stop at the nearest return so far; casters of tables and lines may not.
        lanes farthest = echo.t;
#if LOOKUP
        farthest = limit;
#endif
#if BRESENHAM
        farthest = limit;
#endif
        const lanes met = cast_ray_lanes(map_table, window, cell, pose, x, y, farthest, caster, ahead);
#if SHAPES
        const LanePair shape = nearest_shape_lanes(shapes, world, crowd, n, cell, pose, x, y, met);
        const lanes t = shape.x;
#else
        const lanes t = met;
#endif
        ilanes nearer = t < echo.t;
        if (!any_lane(nearer)) continue;
#if INCIDENCE
        lanes dx, dy, normal_x, normal_y;
        direct_lanes(pose, x, y, &dx, &dy);
        hit_normal_lanes(normals, window, cell, pose, dx, dy, nearer ? t : (lanes)0, &normal_x, &normal_y);
        const lanes along = dx * normal_x + dy * normal_y;
#if SHAPES
        const lanes cosine = t < met ? shape.y : normal_x == normal_x ? fabs(along) : (lanes)1;
#else
        const lanes cosine = normal_x == normal_x ? fabs(along) : (lanes)1;
#endif
        nearer &= ~(cosine < cone.critical);
        echo.cosine = nearer ? cosine : echo.cosine;
#endif
        echo.t = nearer ? t : echo.t;
    }
    return echo;
#else
    load_ray_lanes(ray, first, count, 1, &x, &y);
    const lanes met = cast_ray_lanes(map_table, window, cell, pose, x, y, limit, caster, ahead);
#if SHAPES
    return (EchoLanes){nearest_shape_lanes(shapes, world, crowd, n, cell, pose, x, y, met).x, 2};
#else
    return (EchoLanes){met, 2};
#endif
#endif
}
