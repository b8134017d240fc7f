// Exhaustive search over poses: sums of a table's cells over the end points of a scan. For one heading the end points
// fall into integer cells, and the cells of all positions on the grid are the same ones, shifted. The score of a position
// is the sum of the table over the shifted cells (Olson, Real-time correlative scan matching, ICRA 2009). A pooled table
// holds the largest value of a square of positions, so that its sums are upper bounds of all scores in the square (Hess
// et al., Real-time loop closure in 2D lidar SLAM, ICRA 2016). All sums are sums of integers, so a bound is never below
// a score that it bounds.
//
// Tables are consecutive, each with a margin of cells around the map. An item is a scan at a heading; its points are
// first[item] to first[item + 1] - 1, each of which names the table (image) that it reads. A folded table holds every
// period-th cell of a table as a separate image: shifts by whole periods read neighbours.
// requires: score_cells

// Write the maximum of each cell and the cells up to reach rows and columns further. One work-item takes a cell.
kernel void pool_scores(ARGUMENTS) {
    const int col = get_global_id(0), line = get_global_id(1), image = get_global_id(2);
    const int lines = padded_lines(scores), stride = padded_stride(scores);
    if (col >= stride || line >= lines || image >= scores.tables) return;
    global const uchar *cells = table + image * lines * stride;
    const int low = min(line + reach, lines - 1) * stride, right = min(col + reach, stride - 1);
    const int upper = max((int)cells[line * stride + col], (int)cells[line * stride + right]);
    const int lower = max((int)cells[low + col], (int)cells[low + right]);
    pooled[(image * lines + line) * stride + col] = (uchar)max(upper, lower);
}

// Write every period-th row and column of each padded table as an image, for each of period^2 first cells. One work-item
// takes a cell of an image.
kernel void fold_scores(ARGUMENTS) {
    const int col = get_global_id(0), line = get_global_id(1), image = get_global_id(2);
    const int lines = padded_lines(folded), stride = padded_stride(folded);
    if (col >= stride || line >= lines || image >= folded.tables) return;
    const int source = image / (period * period), phase = image % (period * period);
    const int from_line = (line - folded.margin) * period + phase / period;
    const int from_col = (col - folded.margin) * period + phase % period;
    const int rows = padded_lines(scores), cols = padded_stride(scores);
    const bool within = line >= folded.margin && col >= folded.margin && from_line < rows && from_col < cols;
    out[(image * lines + line) * stride + col] =
        within ? table[(source * rows + from_line) * cols + from_col] : (uchar)beyond;
}

// Sum the cells of each item's points at all shifts by less than height rows and width columns. One work-item takes a
// shift of an item.
kernel void shift_scores(ARGUMENTS) {
    const int col = get_global_id(0), row = get_global_id(1), item = get_global_id(2);
    if (col >= width || row >= height || item >= items) return;
    const int size = padded_lines(scores) * padded_stride(scores), last = first[item + 1];
    int total = 0;
    for (int k = first[item]; k < last; ++k)
        total += table[image[k] * size + cell_index(scores, point[k].y + row, point[k].x + col)];
    score[(item * height + row) * width + col] = total;
}

// Sum the cells of candidates' points; a candidate is an item, and the row and column of its shift. One work-item takes a
// candidate.
kernel void candidate_scores(ARGUMENTS) {
    const int n = get_global_id(0);
    if (n >= candidates) return;
    const int item = candidate[3 * n], row = candidate[3 * n + 1], col = candidate[3 * n + 2];
    const int size = padded_lines(scores) * padded_stride(scores), last = first[item + 1];
    int total = 0;
    for (int k = first[item]; k < last; ++k)
        total += table[image[k] * size + cell_index(scores, point[k].y + row, point[k].x + col)];
    score[n] = total;
}
