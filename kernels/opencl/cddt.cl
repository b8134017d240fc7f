// Expected range by a compressed directional distance transform (Walsh and Karaman 2018); see the reference.
// requires: ray

typedef int entry;

#define ENTRY_UNIT ((real)1024)
// Coordinates are clamped to this many cells: no map has as many, and indices still fit.
#define FARTHEST ((real)1048576)

// Return the distance in cells to the first obstacle of the line, limit where none is nearer.
real cast_ray(global const entry *map_table, const Window window, const int2 cell, const real4 pose, const real2 ray,
              const real limit, const Caster caster) {
    const int lines = map_table[0];
    global const entry *first = map_table + 1 + 3 * caster.bins, *bits = first + caster.bins * lines + 1;
    if (off_grid(cell.x, cell.y, window.rows, window.cols)) {
#if OUTSIDE_OCCUPIED
        return 0;
#endif
    } else {
        const int index = cell.y * window.cols + cell.x;
        if ((uint)bits[index / 32] >> (index % 32) & 1u) return 0;
    }
    const int bin = angle_bin(ray_direction(pose, ray), caster.bins);
    const real c = (real)map_table[1 + 3 * bin] * (real)9.31322574615478515625e-10;
    const real s = (real)map_table[2 + 3 * bin] * (real)9.31322574615478515625e-10;
    const real x = (real)cell.x + pose.x, y = (real)cell.y + pose.y;
    const real along = c * x + s * y, across = c * y - s * x;
    if (fabs(across) > FARTHEST) return limit;
    const int line = floor_int(across) - map_table[3 + 3 * bin];
    if (line < 0 || line >= lines) return limit;
    const int from = (int)(along > FARTHEST ? FARTHEST * ENTRY_UNIT : along < -FARTHEST ? -FARTHEST * ENTRY_UNIT
                           : along * ENTRY_UNIT);
    int low = first[bin * lines + line], high = first[bin * lines + line + 1];
    const int end = high;
    while (low < high) {
        const int middle = low + (high - low) / 2;
        if (map_table[middle] < from)
            low = middle + 1;
        else
            high = middle;
    }
    if (low == end) return limit;
    const real t = (real)map_table[low] / ENTRY_UNIT - along;
    return t < 0 ? (real)0 : t < limit ? t : limit;
}
