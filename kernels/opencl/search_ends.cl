// End points of scans at all headings, as cells of tables of scores; see search.cl.

// Return the quotient of integers, rounded down.
int floored(const int number, const int divisor) {
    const int quotient = number / divisor;
    return quotient * divisor > number ? quotient - 1 : quotient;
}

// Place the end points of a scan at a heading: the cells of points, and runs of neighbouring points of the same cell of a
// folded table, by 64 at most. One work-item takes an item.
kernel void place_ends(ARGUMENTS) {
    const int item = get_global_id(0);
    if (item >= items) return;
    const int scan = item / turns, begin = first[item], last = first[item + 1], side = period / step;
    const int ends = first[scan * turns] / turns;
    const double cosine = heading[2 * item], sine = heading[2 * item + 1];
    const double start_x = start[2 * scan], start_y = start[2 * scan + 1];
    int made = begin - 1;
    for (int k = begin; k < last; ++k) {
        const double x = end[2 * (ends + k - begin)], y = end[2 * (ends + k - begin) + 1];
        const double across = cosine * x - sine * y, along = sine * x + cosine * y;
        const int2 cell = (int2)((int)floor(start_x + across), (int)floor(start_y + along));
        point[k] = cell;
        const int2 folded = (int2)(floored(cell.x + offset, period), floored(cell.y + offset, period));
        const int col = (cell.x + offset - folded.x * period) / step, row = (cell.y + offset - folded.y * period) / step;
        const int chosen = (image[k] * side + row) * side + col;
        const bool same = (k - begin) % 64 > 0 && run[made].x == folded.x && run[made].y == folded.y;
        if (same && run_image[made] == chosen) {
            weight[made] += 1;
        } else {
            ++made;
            run[made] = folded;
            run_image[made] = chosen;
            weight[made] = 1;
        }
    }
    runs[item] = made + 1 - begin;
}
