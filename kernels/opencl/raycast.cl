// Expected range z*: the exact distance from a beam's origin to the first occupied cell (book section 6.3); see the
// reference.
// requires: rectangles ray

typedef ushort entry;

#if SECTORS_4
#define SECTORS 4
#else
#if SECTORS_2
#define SECTORS 2
#else
#define SECTORS 1
#endif
#endif

// Planes of a map.
#define PLANES (4 * SECTORS)

// Return the sector of a direction within its quadrant, from flat to steep. A wrong sector would cost steps, but not
// change the result.
int sector_of(const real speed_x, const real speed_y) {
#if SECTORS_4
    const int steep = speed_y > speed_x;
    return 2 * steep + (speed_y > (steep ? (real)2.4142136 : (real)0.41421356) * speed_x);
#else
#if SECTORS_2
    return speed_y > speed_x;
#else
    return 0;
#endif
#endif
}

// Rows of a group of the planes; without ROW_GROUPS a group is a single row.
#if ROW_GROUPS
#define GROUP_BITS 3
#else
#define GROUP_BITS 0
#endif
#define GROUP (1 << GROUP_BITS)

// The track of a ray through a plane: index of the origin's column, the origin's row, and steps in x and y,
// so that boundaries COUNT + k need no conversion; skip is what a group has beyond its first column.
typedef struct Track {
    uint col, row, step_x, step_y, skip;
} Track;

// Return the track of a ray that begins in a cell through the plane of its direction.
Track track_of(const Ray r, const int2 cell, const Window window) {
    const uint plane = ((r.right ? 0 : 1) + (r.up ? 0 : 2)) * SECTORS + sector_of(r.speed_x, r.speed_y);
    const uint stride = GROUP * (window.cols + 2), groups = (window.rows + 2 + GROUP - 1) / GROUP;
    Track track;
    track.step_x = GROUP * r.step_x;
    track.col = plane * groups * stride + GROUP * (cell.x + 1) - track.step_x * FIRST;
    track.skip = stride - GROUP;
#if ROW_GROUPS
    track.step_y = r.step_y;
    track.row = cell.y + 1 - track.step_y * FIRST;
#else
    track.step_y = stride * r.step_y;
    track.row = 0;
    track.col += stride * (cell.y + 1) - track.step_y * FIRST;
#endif
    return track;
}

// Return the rectangle at the cell of a track behind k_x and k_y boundaries.
uint rectangle_at(global const entry *map_table, const Track track, const real k_x, const real k_y) {
    const uint col = track.col + track.step_x * (uint)as_bits(k_x);
#if ROW_GROUPS
    const uint row = track.row + track.step_y * (uint)as_bits(k_y);
    return map_table[(int)(col + row + row / GROUP * track.skip)];
#else
    return map_table[(int)(col + track.step_y * (uint)as_bits(k_y))];
#endif
}

// Return the distance in cells to the first occupied cell, limit where none is nearer.
real cast_ray(global const entry *map_table, const Window window, const int2 cell, const real4 pose, const real2 ray,
              const real limit, const Caster caster) {
    const Ray r = make_ray(pose, ray);
#if OUTSIDE_OCCUPIED
#if ORIGINS_OUTSIDE
    if (off_grid(cell.x, cell.y, window.rows, window.cols)) return 0;
#endif
#endif
    const Walk start = start_walk(r, cell, window, limit);
#if ORIGINS_OUTSIDE
    if (start.t >= limit) return limit;
#endif
    const Track track = track_of(r, cell, window);
    real k_x = COUNT + (real)start.k_x, k_y = COUNT + (real)start.k_y, t = start.t;
    uint sides = rectangle_at(map_table, track, k_x, k_y);
    // A step beyond limit still ends in the table. GPUs are fastest with a single exit of the loop.
    while (sides > OCCUPIED && t < limit) {
        const real end_x = as_real(as_bits(k_x) + (sides & 255)), end_y = as_real(as_bits(k_y) + (sides >> 8));
        const real t_x = ((end_x - (COUNT + 1)) + r.a_x) * r.inv_x, t_y = ((end_y - (COUNT + 1)) + r.a_y) * r.inv_y;
        const int by_x = t_x <= t_y;
        t = by_x ? t_x : t_y;
        const real aside = crossed(t, by_x ? r.speed_y : r.speed_x, by_x ? r.a_y : r.a_x, by_x ? r.inv_y : r.inv_x,
                                   !by_x);
        k_x = by_x ? end_x : aside;
        k_y = by_x ? aside : end_y;
        sides = rectangle_at(map_table, track, k_x, k_y);
    }
#if OUTSIDE_OCCUPIED
    return t < limit ? t : limit;
#else
    return t < limit && sides == OCCUPIED ? t : limit;
#endif
}

