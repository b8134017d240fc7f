// Tables of scores for searches over poses: pooled, folded, and packed as numbers; see the reference.
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

// Write the losses of every period-th row and column of each padded table as an image, for each of (period / step)^2 first
// cells, step apart. One work-item takes a cell of an image.
kernel void fold_scores(ARGUMENTS) {
    const int col = get_global_id(0), line = get_global_id(1), image = get_global_id(2);
    const int lines = padded_lines(folded), stride = padded_stride(folded);
    if (col >= stride || line >= lines || image >= folded.tables) return;
    const int side = period / step, source = image / (side * side), phase = image % (side * side);
    const int from_line = (line - folded.margin) * period + phase / side * step;
    const int from_col = (col - folded.margin) * period + phase % side * step;
    const int rows = padded_lines(scores), cols = padded_stride(scores);
    const bool within = line >= folded.margin && col >= folded.margin && from_line < rows && from_col < cols;
    const int value = within ? table[(source * rows + from_line) * cols + from_col] : beyond;
    out[(image * lines + line) * stride + col] = (uchar)((TOP - value) / unit);
}

// Return the scores of the quarters of the block that begins at a cell: upper left, upper right, lower left, lower right. A
// quarter has reach rows and columns.
int4 quarters_at(global const uchar *cells, const ScoreTable scores, const int line, const int col, const int reach) {
    const int lines = padded_lines(scores), stride = padded_stride(scores);
    const int low = min(line + reach, lines - 1) * stride, right = min(col + reach, stride - 1);
    return (int4)(cells[line * stride + col], cells[line * stride + right], cells[low + col], cells[low + right]);
}

// Return losses of quarters as bytes of a number.
int packed_losses(const int most, const int4 four) {
    return (int)((uint)(most - four.x) | (uint)(most - four.y) << 8 | (uint)(most - four.z) << 16 | (uint)(most - four.w) << 24);
}

// Write the losses of the quarters of the block that begins at each cell, relative to the largest of the four scores. One
// work-item takes a cell.
kernel void pack_quarters(ARGUMENTS) {
    const int col = get_global_id(0), line = get_global_id(1), image = get_global_id(2);
    const int lines = padded_lines(scores), stride = padded_stride(scores);
    if (col >= stride || line >= lines || image >= scores.tables) return;
    const int4 four = quarters_at(table + image * lines * stride, scores, line, col, reach);
    const int most = max(max(four.x, four.y), max(four.z, four.w));
    quarters[(image * lines + line) * stride + col] = packed_losses(most, four);
}

// Write the losses of the quarters of blocks, relative to the blocks' scores in the folded table of bounds, as images of
// every period-th row and column: one for each of period^2 first cells. With across, the cells of a column follow each
// other, as the chosen blocks of a column do. One work-item takes a cell of an image.
kernel void fold_quarters(ARGUMENTS) {
    const int col = get_global_id(0), line = get_global_id(1), image = get_global_id(2);
    const int lines = padded_lines(folded), stride = padded_stride(folded);
    if (col >= stride || line >= lines || image >= folded.tables) return;
    const int source = image / (period * period), row_phase = image / period % period, col_phase = image % period;
    const int whole_row = line - folded.margin, whole_col = col - folded.margin, side = period / step;
    const int from_line = whole_row * period + row_phase, from_col = whole_col * period + col_phase;
    const int rows = padded_lines(scores), cols = padded_stride(scores);
    int4 four = (int4)(beyond);
    if (whole_row >= 0 && whole_col >= 0 && from_line < rows && from_col < cols)
        four = quarters_at(table + source * rows * cols, scores, from_line, from_col, reach);
    const int coarse = (source * side + row_phase / step) * side + col_phase / step;
    const int loss = bound[coarse * padded_lines(bounds) * padded_stride(bounds) + block_index(bounds, whole_row, whole_col, 0, 0)];
    const int place = across ? col * lines + line : line * stride + col;
    quarters[image * lines * stride + place] = packed_losses(TOP - unit * loss, four);
}

// Write the losses of each cell and the three below it as bytes of a number. One work-item takes a cell.
kernel void pack_rows(ARGUMENTS) {
    const int col = get_global_id(0), line = get_global_id(1), image = get_global_id(2);
    const int lines = padded_lines(scores), stride = padded_stride(scores);
    if (col >= stride || line >= lines || image >= scores.tables) return;
    uint four = 0;
    for (int i = 0; i < 4; ++i) four |= (uint)table[(image * lines + min(line + i, lines - 1)) * stride + col] << (8 * i);
    packed[(image * lines + line) * stride + col] = (int)four;
}
