// Cells of consecutive tables of scores, each with a margin of cells around the map.

// Return the rows of a table with its margin.
int padded_lines(const ScoreTable scores) { return scores.rows + 2 * scores.margin; }

// Return the columns of a table with its margin.
int padded_stride(const ScoreTable scores) { return scores.cols + 2 * scores.margin; }

// Return the nearest number from 0 to last. Comparisons, since PoCL compiles min and max as calls.
int within(const int number, const int last) { return number < 0 ? 0 : number > last ? last : number; }

// Return the index of a cell in its table, from which cells up to rows lines and cols columns further are read; cells beyond
// the margin have the value of the margin's outer cells.
int block_index(const ScoreTable scores, const int row, const int col, const int rows, const int cols) {
    const int stride = padded_stride(scores);
    return within(row + scores.margin, padded_lines(scores) - 1 - rows) * stride + within(col + scores.margin, stride - 1 - cols);
}
