// End points of scans at all headings, as cells of tables of scores; see search.cl.

// Return a cell divided by stride * 2^level, rounded down.
int periods(const int cell, const int stride, const int level) {
    const int number = cell >> level, quotient = stride == 1 ? number : number / stride;
    return quotient * stride > number ? quotient - 1 : quotient;
}

// Return the cell of a place. PoCL compiles floor as a call.
int cell_of(const double place) {
    const int cell = (int)place;
    return cell > place ? cell - 1 : cell;
}

// Place the end points of a scan at a heading in cells of the tables, in cells of folded tables, and in the images of folded
// bounds and of folded quarters, each by its first cell; numbers of tables become their first cells. One work-item takes each workers-th point of an item.
kernel void place_ends(ARGUMENTS) {
    const int item = get_global_id(1);
    if (item >= items || get_global_id(0) >= workers) return;
    const int scan = item / turns, side = stride << (level - step_level), period = stride << level;
    const double cosine = heading[2 * item], sine = heading[2 * item + 1], x0 = start[2 * scan], y0 = start[2 * scan + 1];
    global const double *ends = end + 2 * (first[scan * turns] / turns);
#if READ_AHEAD
    for (int k = first[item] + get_global_id(0), n = get_global_id(0); k < first[item + 1]; k += workers, n += workers) {
#else
    // A single worker, so that compilers make vector code.
    const int begin = first[item], last = first[item + 1];
    for (int k = begin, n = 0; k < last; ++k, ++n) {
#endif
        const int table = image[k];
        const double across = cosine * ends[2 * n] - sine * ends[2 * n + 1], along = sine * ends[2 * n] + cosine * ends[2 * n + 1];
        const int2 cell = (int2)(cell_of(x0 + across), cell_of(y0 + along));
        const int x = cell.x + offset, y = cell.y + offset;
        const int2 whole = (int2)(periods(x, stride, level), periods(y, stride, level));
        const int col = x - whole.x * period, row = y - whole.y * period;
        point[k] = cell;
        folded[k] = whole;
        image[k] = size * table;
        bound_image[k] = bound_size * ((table * side + (row >> step_level)) * side + (col >> step_level));
        quarter_image[k] = quarter_size * ((table * period + row) * period + col);
    }
}
