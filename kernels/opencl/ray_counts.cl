// Counts of hits and misses of cells, of which the log-odds of an occupancy grid are sums (book section 9.2). Start and
// end of a ray are cells and places inside them in units of 1/4096 cell, and the walk from cell to cell compares products
// of integers, so that all backends visit the same cells. A ray misses each cell that it leaves. Its last cell is hit
// where the ray ends at an obstacle, and missed otherwise. A tie, the ray through a corner, steps in x first.

// Fraction bits of a coordinate.
#define BITS 12
#define UNIT (1 << BITS)

// Return the distance along an axis to the first boundary that a ray crosses.
int to_boundary(const int inside, const int step) {
    return step > 0 ? UNIT - inside : inside;
}

// Return whether a walk has left an axis of some cells, to which it does not return.
bool has_left(const int cell, const int step, const int cells) {
    return step > 0 ? cell >= cells : cell < 0;
}

// Add the cells of rays to the counts; cells outside the grid are left out. One work-item takes a ray.
kernel void count_rays(global const int2 *start_cell, global const int2 *start_inside, global const int2 *end_cell,
                       global const int2 *end_inside, global const int *hit, global int *hits, global int *misses,
                       const int rows, const int cols, const int rays) {
    const int n = get_global_id(0);
    if (n >= rays) return;
    const int2 begin = start_inside[n], across = end_cell[n] - start_cell[n];
    int col = start_cell[n].x, row = start_cell[n].y;
    const long span_x = (long)across.x * UNIT + (end_inside[n].x - begin.x);
    const long span_y = (long)across.y * UNIT + (end_inside[n].y - begin.y);
    const int step_x = span_x >= 0 ? 1 : -1, step_y = span_y >= 0 ? 1 : -1;
    const long size_x = step_x * span_x, size_y = step_y * span_y;
    int left_x = step_x * across.x, left_y = step_y * across.y;
    // Negative where the next boundary is one in x.
    long lead = to_boundary(begin.x, step_x) * size_y - to_boundary(begin.y, step_y) * size_x;
    while (!has_left(col, step_x, cols) && !has_left(row, step_y, rows)) {
        const bool at_end = left_x + left_y == 0;
        if (col >= 0 && col < cols && row >= 0 && row < rows)
            atomic_add((at_end && hit[n] ? hits : misses) + (row * cols + col), 1);
        if (at_end) return;
        if (left_x > 0 && (left_y == 0 || lead <= 0)) {
            col += step_x;
            --left_x;
            lead += UNIT * size_y;
        } else {
            row += step_y;
            --left_y;
            lead -= UNIT * size_x;
        }
    }
}
