// A ray on the grid and the walk along it, which all casters share. Distances of boundaries are (k + a) * inv with an
// integer count k of boundaries; they are never accumulated.
// requires: error_free
// Casts and comparisons take the place of floor, ceil, fmin and fmax, which some drivers call as functions.

// Counts k of boundaries are floating-point numbers COUNT + k. From COUNT on all numbers are integers, so a sum with
// COUNT is rounded to nearest. The last bits of a count are k + FIRST, so a count is an index without a conversion.
#if FLOAT64
#define COUNT ((real)4503599627370496.0)
#define FIRST 0u
#define as_bits as_long
#define as_real as_double
#else
#define COUNT ((real)8388608)
#define FIRST 0x4b000000u
#define as_bits as_int
#define as_real as_float
#endif

// Smaller components of a direction count as 0, so that inverses are finite.
#define TINY ((real)1e-30)

// A ray in the grid's frame: its unit direction; sign, absolute value and inverse of each component; and the distances
// in x and y to the first boundaries.
typedef struct {
    real2 direction;
    int right, up, step_x, step_y;
    real speed_x, speed_y, inv_x, inv_y, a_x, a_y;
} Ray;

// State of a walk: boundaries crossed in x and y, and the distance in cells.
typedef struct {
    int k_x, k_y;
    real t;
} Walk;

// Return whether a cell lies outside the grid.
int off_grid(const int col, const int row, const int rows, const int cols) {
    return col < 0 || col >= cols || row < 0 || row >= rows;
}

// Return the unit direction in the grid's frame: pose (frac x, frac y, cos, sin) turned by the beam's (cos, sin).
real2 ray_direction(const real4 pose, const real2 ray) {
    const real dx = pose.z * ray.x - pose.w * ray.y;
    const real dy = pose.w * ray.x + pose.z * ray.y;
    return (real2)(fabs(dx) < TINY ? (real)0 : dx, fabs(dy) < TINY ? (real)0 : dy);
}

// Return the ray of a pose and a beam.
Ray make_ray(const real4 pose, const real2 ray) {
    Ray r;
    r.direction = ray_direction(pose, ray);
    r.right = r.direction.x >= 0, r.up = r.direction.y >= 0;
    r.step_x = r.right ? 1 : -1, r.step_y = r.up ? 1 : -1;
    r.speed_x = fabs(r.direction.x), r.speed_y = fabs(r.direction.y);
    r.inv_x = (real)1 / r.speed_x, r.inv_y = (real)1 / r.speed_y;
    r.a_x = r.right ? (real)1 - pose.x : pose.x, r.a_y = r.up ? (real)1 - pose.y : pose.y;
    return r;
}

// Return k of a count.
int whole(const real count) { return (int)((uint)as_bits(count) - FIRST); }

// Count the boundaries k = 0, 1, ... whose distance (k + a) * inv is below t, or with ``until`` at most t. Only the
// boundary nearest to the coordinate at t can be in doubt.
real crossed(const real t, const real speed, const real a, const real inv, const integer until) {
    const real least = COUNT, place = (t * speed - a) + COUNT, count = place > least ? place : least;
    const real here = ((count - COUNT) + a) * inv;
    return (here < t) | (until & (here == t)) ? count + 1 : count;
}

// Return the walk at the ray's origin or, where that lies outside the grid, at the first cell inside; t is limit where
// a ray from outside does not meet the grid before limit.
Walk start_walk(const Ray r, const int2 cell, const Window window, const real limit) {
    Walk walk = {0, 0, 0};
#if ORIGINS_OUTSIDE
    if (off_grid(cell.x, cell.y, window.rows, window.cols)) {
        const int enter_x = max(r.right ? -cell.x : cell.x - (window.cols - 1), 0);
        const int enter_y = max(r.up ? -cell.y : cell.y - (window.rows - 1), 0);
        const real enter_t_x = enter_x > 0 ? ((real)(enter_x - 1) + r.a_x) * r.inv_x : (real)-1;
        const real enter_t_y = enter_y > 0 ? ((real)(enter_y - 1) + r.a_y) * r.inv_y : (real)-1;
        const real t = enter_t_x > enter_t_y ? enter_t_x : enter_t_y;
        walk.t = limit;
        if (!(t >= 0 && t < limit)) return walk;
        if (enter_t_x > enter_t_y) {
            walk.k_x = enter_x;
            walk.k_y = whole(crossed(t, r.speed_y, r.a_y, r.inv_y, 0));
        } else {
            walk.k_y = enter_y;
            walk.k_x = whole(crossed(t, r.speed_x, r.a_x, r.inv_x, 1));
        }
        if (!off_grid(cell.x + r.step_x * walk.k_x, cell.y + r.step_y * walk.k_y, window.rows, window.cols)) walk.t = t;
    }
#endif
    return walk;
}

// Return a direction as a part of a full turn in [0, 1], within 2e-6: Abramowitz and Stegun 4.4.49 for the arc tangent.
real turn_of(const real dx, const real dy) {
    const real x = fabs(dx), y = fabs(dy);
    const real a = (x > y ? y : x) / (x > y ? x : y), s = a * a;
    const real tail = (real)0.02867033 + s * ((real)-0.01354934 + s * (real)0.00331601);
    const real eighth = a * ((real)0.15913362 + s * ((real)-0.05256880 + s * tail));
    const real quarter = x > y ? eighth : (real)0.25 - eighth;
    const real upper = dx >= 0 ? quarter : (real)0.5 - quarter;
    return dy >= 0 ? upper : (real)1 - upper;
}

// Return the angle bin with the nearest centre; centres are at 0, 1 / bins, ... of a turn.
int angle_bin(const real2 direction, const int bins) {
    const int bin = (int)(turn_of(direction.x, direction.y) * (real)bins + (real)0.5);
    return bin >= bins ? bin - bins : bin;
}

// Convert a distance in cells to metres, exactly range_max where nothing is nearer, or with AMCL_LINES where nothing is
// met.
real expected_range(const real t, const RangeScale scale) {
    const real range = t * scale.resolution, most = scale.range_max;
#if AMCL_LINES
    return t == scale.limit ? most : range;
#else
    return (t >= scale.limit) | (range > most) ? most : range;
#endif
}

// Tiles of work-items for GPUs: a work-group takes a tile of neighbouring particles and rays with similar paths. spread
// = s gives a tile of particles 2^s groups, each with every 2^s-th tile of rays, so that few particles also fill a
// device. Particles are in the order of the file order, if it was computed.

// Return the place of a work-item's particle in the order.
int tile_place(const int item, const int spread) {
    return ((item / TILE) >> spread) * TILE_PARTICLES + item % TILE / TILE_RAYS;
}

// Return a work-item's group within its tile of particles.
int tile_group(const int item, const int spread) { return (item / TILE) & ((1 << spread) - 1); }

// Return the first ray of a work-item.
int tile_ray(const int item, const int spread) { return tile_group(item, spread) * TILE_RAYS + item % TILE_RAYS; }

// Return the step from one ray of a work-item to its next.
int tile_step(const int spread) { return TILE_RAYS << spread; }
