// Cells of consecutive tables of scores, each with a margin of cells around the map.

// Return the rows of a table with its margin.
int padded_lines(const ScoreTable scores) { return scores.rows + 2 * scores.margin; }

// Return the columns of a table with its margin.
int padded_stride(const ScoreTable scores) { return scores.cols + 2 * scores.margin; }

// Return the nearest number from 0 to last. Comparisons, since PoCL compiles min and max as calls.
int within(const int number, const int last) { return number < 0 ? 0 : number > last ? last : number; }

// Return the nearest numbers from 0 to last, without comparisons of vectors, which PoCL compiles lane by lane.
int8 within8(const int8 number, const int last) {
    const int8 some = number & ~(number >> 31), left = last - some;
    return some + (left & left >> 31);
}

// Return the index of a cell in its table, from which cells up to rows lines and cols columns further are read; cells beyond
// the margin have the value of the margin's outer cells.
int block_index(const ScoreTable scores, const int row, const int col, const int rows, const int cols) {
    const int stride = padded_stride(scores);
    return within(row + scores.margin, padded_lines(scores) - 1 - rows) * stride + within(col + scores.margin, stride - 1 - cols);
}

// Vectors at any address; PoCL compiles loads of vectors as calls.
typedef int16 EightPoints __attribute__((aligned(4)));
typedef int8 Eight __attribute__((aligned(4)));

// Return the indices of the cells of eight points from a cell on, see block_index, in their images.
int8 block_indices(global const int2 *point, global const int *image, const ScoreTable scores, const int row, const int col,
                   const int rows, const int cols) {
    const int16 both = *(global const EightPoints *)point;
    const int stride = padded_stride(scores);
    const int8 line = within8(both.odd + (row + scores.margin), padded_lines(scores) - 1 - rows);
    const int8 aside = within8(both.even + (col + scores.margin), stride - 1 - cols);
    return *(global const Eight *)image + line * stride + aside;
}
