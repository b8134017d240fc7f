// End points of scans at all headings, as cells of tables of scores; see search.cl.

// Return the quotient of integers, rounded down.
int floored(const int number, const int divisor) {
    const int quotient = number / divisor;
    return quotient * divisor > number ? quotient - 1 : quotient;
}

// Place the end points of a scan at a heading in cells of the tables, and in cells and images of a folded table. One
// work-item takes an item.
kernel void place_ends(ARGUMENTS) {
    const int item = get_global_id(0);
    if (item >= items) return;
    const int scan = item / turns, begin = first[item], last = first[item + 1], side = period / step;
    const int ends = first[scan * turns] / turns;
    const double cosine = heading[2 * item], sine = heading[2 * item + 1];
    const double start_x = start[2 * scan], start_y = start[2 * scan + 1];
    for (int k = begin; k < last; ++k) {
        const double x = end[2 * (ends + k - begin)], y = end[2 * (ends + k - begin) + 1];
        const double across = cosine * x - sine * y, along = sine * x + cosine * y;
        const int2 cell = (int2)((int)floor(start_x + across), (int)floor(start_y + along));
        const int2 whole = (int2)(floored(cell.x + offset, period), floored(cell.y + offset, period));
        const int col = (cell.x + offset - whole.x * period) / step, row = (cell.y + offset - whole.y * period) / step;
        point[k] = cell;
        folded[k] = whole;
        folded_image[k] = (image[k] * side + row) * side + col;
    }
}
