// Cells of consecutive tables of scores, each with a margin of cells around the map.

// Return the rows of a table with its margin.
int padded_lines(const ScoreTable scores) { return scores.rows + 2 * scores.margin; }

// Return the columns of a table with its margin.
int padded_stride(const ScoreTable scores) { return scores.cols + 2 * scores.margin; }

// Return the index of a cell in its table, from which cells up to rows lines and cols columns further are read; cells beyond
// the margin have the value of the margin's outer cells.
int block_index(const ScoreTable scores, const int row, const int col, const int rows, const int cols) {
    // Comparisons, since PoCL compiles min and max as calls.
    const int last_line = padded_lines(scores) - 1 - rows, last_col = padded_stride(scores) - 1 - cols;
    const int line = row + scores.margin, begin = col + scores.margin;
    return (line < 0 ? 0 : line > last_line ? last_line : line) * padded_stride(scores) +
           (begin < 0 ? 0 : begin > last_col ? last_col : begin);
}
