// The nearest return among the rays of a sensor's cone (one ray for a laser), and its angle of incidence; see the
// reference.
// requires: caster mixture shapes

#if CONES
// Distance in cells, and cosine and sine of the angle of incidence. A beam without a return gets limit, 2 and 0: 2
// exceeds every cosine, so that the first bin can hold such beams alone.
typedef struct {
    real t, cosine, sine;
} Echo;

#if INCIDENCE
// Return whether a normal belongs to an obstacle.
int is_wall(const real2 normal) { return normal.x != 0 || normal.y != 0; }

// Return the normal of a cell; beyond the ring cells are free, or with OUTSIDE_OCCUPIED occupied without a normal.
real2 normal_at(global const real2 *normals, const Window window, const int col, const int row) {
    if (off_grid(col + 1, row + 1, window.rows + 2, window.cols + 2)) {
#if OUTSIDE_OCCUPIED
        return (real2)(NAN, NAN);
#else
        return (real2)(0, 0);
#endif
    }
    return normals[padded(row, col, window.cols)];
}

// Return the normal of the cell in which a ray ends at a distance t. The distance determines the cell of the exact
// walk: it has crossed all boundaries in x up to t, and all boundaries in y before t, or up to t after a step in y. At
// a corner it steps in x first.
real2 hit_normal(global const real2 *normals, const Window window, const int2 cell, const Ray r, const real t) {
    if (t == 0) {
        const real2 start_normal = normal_at(normals, window, cell.x, cell.y);
        if (is_wall(start_normal)) return start_normal;
    }
    const int col = cell.x + r.step_x * whole(crossed(t, r.speed_x, r.a_x, r.inv_x, 1));
    const int before = cell.y + r.step_y * whole(crossed(t, r.speed_y, r.a_y, r.inv_y, 0));
    const real2 normal = normal_at(normals, window, col, before);
    if (is_wall(normal)) return normal;
    return normal_at(normals, window, col, cell.y + r.step_y * whole(crossed(t, r.speed_y, r.a_y, r.inv_y, 1)));
}

// Return the terms of the mixture for the bin of an angle of incidence; edges are cosines of the bins' upper ends.
global const MixtureTerms *incidence_terms(global const MixtureTerms *terms, global const real *edges,
                                           const int incidence_bins, const real cosine) {
    int bin = 0;
    while (bin + 1 < incidence_bins && cosine <= edges[bin]) ++bin;
    return terms + bin;
}
#endif

// Return the nearest return of a cone's rays. A ray whose angle of incidence has a cosine below critical has none: the
// surface reflects it like a mirror.
Echo nearest_echo(global const entry *map_table, global const real2 *normals, const Window window, const int2 cell,
                  const real4 pose, global const real2 *ray, const Cone cone, const real limit, const Caster caster,
                  global const real *shapes, global const int2 *world, const Crowd crowd, const int n) {
    Echo echo = {limit, 2, 0};
    for (int i = 0; i < cone.rays; ++i) {
        // Most casters may stop at the nearest return so far; casters of tables and lines may not.
        real farthest = echo.t;
#if LOOKUP
        farthest = limit;
#endif
#if BRESENHAM
        farthest = limit;
#endif
        const real met = cast_ray(map_table, window, cell, pose, ray[i], farthest, caster);
#if SHAPES
        const real2 shape = nearest_shape(shapes, world, crowd, n, cell, pose, ray[i], met);
        const real t = shape.x;
#else
        const real t = met;
#endif
        if (!(t < echo.t)) continue;
#if INCIDENCE
#if SHAPES
        if (t < met) {
            if (shape.y < cone.critical) continue;
            echo = (Echo){t, shape.y, sqrt((1 - shape.y) * (1 + shape.y))};
            continue;
        }
#endif
        const Ray r = make_ray(pose, ray[i]);
        const real2 normal = hit_normal(normals, window, cell, r, t);
        const int known = !isnan(normal.x);
        const real cosine = known ? fabs(r.direction.x * normal.x + r.direction.y * normal.y) : (real)1;
        if (cosine < cone.critical) continue;
        echo.cosine = cosine;
        echo.sine = known ? fabs(r.direction.x * normal.y - r.direction.y * normal.x) : (real)0;
#endif
        echo.t = t;
    }
    return echo;
}

// Cast cones to expected ranges and angles of incidence, NaN without a return; with COSINES to the angles' cosines, 2
// without a return. One work-item takes a particle and cone.
kernel void cast_echoes(ARGUMENTS) {
    const int k = get_global_id(0), n = get_global_id(1);
    if (k >= rays || n >= particles) return;
#if WORLDS
    const Window seen = world_window(world, n);
    map_table += world_begin(world, n, PLANES);
    normals += world_begin(world, n, 1);
#else
    const Window seen = window;
#endif
    const Echo echo = nearest_echo(map_table, normals, seen, pose_cell[n], pose[n], ray + k * cone.rays, cone,
                                   scale.limit, caster, shapes, world, crowd, n);
    ranges[(long)n * rays + k] = expected_range(echo.t, scale);
#if INCIDENCE
#if COSINES
    incidence[(long)n * rays + k] = echo.cosine;
#else
    incidence[(long)n * rays + k] = echo.t < scale.limit ? atan2(echo.sine, echo.cosine) : NAN;
#endif
#endif
}
#endif
