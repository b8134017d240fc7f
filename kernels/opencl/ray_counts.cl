// Counts of hits and misses of cells, of which the log-odds of an occupancy grid are sums (book section 9.2); see the
// reference.

#define UNIT (1 << RAY_BITS)

// Return the distance along an axis to the first boundary that a ray crosses.
int to_boundary(const int inside, const int step) {
    return step > 0 ? UNIT - inside : inside;
}

// Return whether a walk has left the extent of an axis for good.
bool has_left(const int cell, const int step, const int cells) {
    return step > 0 ? cell >= cells : cell < 0;
}

// Return the number of boundaries of an axis that a ray crosses before a boundary of the other axis.
// Products of lengths fit in 64 bits, since rays span at most 2^19 cells.
long crossed_before(const int first, const long size, const long reached, const long other, const int ties) {
    const long room = reached * size - first * other - (1 - ties);
    return room < 0 ? 0 : room / (UNIT * other) + 1;
}

// Add the cells of rays to the counts; cells outside the grid are left out. One work-item takes a ray.
kernel void count_rays(ARGUMENTS) {
    const int n = get_global_id(0);
    if (n >= rays) return;
    const int2 begin = start_inside[n], across = end_cell[n] - start_cell[n];
    int col = start_cell[n].x, row = start_cell[n].y;
    const long span_x = (long)across.x * UNIT + (end_inside[n].x - begin.x);
    const long span_y = (long)across.y * UNIT + (end_inside[n].y - begin.y);
    const int step_x = span_x >= 0 ? 1 : -1, step_y = span_y >= 0 ? 1 : -1;
    const long size_x = step_x * span_x, size_y = step_y * span_y;
    int left_x = step_x * across.x, left_y = step_y * across.y;
    const int first_x = to_boundary(begin.x, step_x), first_y = to_boundary(begin.y, step_y);
    // Skip the steps that bring the walk to the grid's columns and rows.
    const int need_x = max(step_x > 0 ? -col : col - (cols - 1), 0);
    const int need_y = max(step_y > 0 ? -row : row - (rows - 1), 0);
    if (need_x > left_x || need_y > left_y) return;
    long done_x = need_x, done_y = 0;
    if (need_x > 0)
        done_y = min(crossed_before(first_y, size_y, first_x + (done_x - 1) * UNIT, size_x, 0), (long)left_y);
    if (done_y < need_y) {
        done_y = need_y;
        done_x = min(crossed_before(first_x, size_x, first_y + (done_y - 1) * UNIT, size_y, 1), (long)left_x);
    }
    col += step_x * (int)done_x, row += step_y * (int)done_y;
    left_x -= (int)done_x, left_y -= (int)done_y;
    // Negative where x has the next boundary.
    long lead = (first_x + done_x * UNIT) * size_y - (first_y + done_y * UNIT) * size_x;
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
