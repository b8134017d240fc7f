// Quadrant empty squares: for each cell and each of the four diagonal directions, the side of the largest square of
// free cells that has the cell at its corner and grows that way, at most 255. A ray may cross such a square in one
// step without missing an obstacle. Source: anisotropic Chebyshev distance maps (Deakin and Knackstedt 2020).
// Planes are padded by a ring of zeros, so a walk that leaves the grid stops there. Plane q grows to
// (+x, +y), (-x, +y), (+x, -y), (-x, -y) for q = 0, 1, 2, 3.
//
// The four planes may be made anew where only the cells in rows [top, bottom) and columns [left, right) of the map
// changed: then only cells whose squares can hold one of these are. Made at first, all of them have changed. What is
// known of occupied cells is a band of whole rows of the map from row first on.
// requires: bits

#define LONGEST 255
// Cells from a changed cell to the farthest one whose square holds it.
#define SQUARE_REACH 254

int padded(const int row, const int col, const int cols) { return (row + 1) * (cols + 2) + col + 1; }

// Along an axis: the cells whose squares, growing to larger (way 1) or smaller (way -1) indices, can hold one of those
// in [low, high) are those from reach_begin to before reach_end.
int reach_begin(const int way, const int low) { return way > 0 ? max(low - SQUARE_REACH, 0) : low; }
int reach_end(const int way, const int high, const int size) { return way > 0 ? high : min(high + SQUARE_REACH, size); }

// For serial devices, one work-item a row of the band and direction: free cells in the row, to the right (direction 0)
// or left (direction 1), as far as from begin to end.
kernel void square_runs(global const uchar *occupied, global uchar *runs, const int band, const int cols,
                        const int begin, const int end) {
    const int row = get_global_id(0), leftward = get_global_id(1);
    if (row >= band) return;
    global uchar *out = runs + (long)leftward * band * cols + (long)row * cols;
    global const uchar *cell = occupied + (long)row * cols;
    int run = 0;
    for (int i = 0; i < end - begin; ++i) {
        const int col = leftward ? begin + i : end - 1 - i;
        run = cell[col] ? 0 : min(run + 1, LONGEST);
        out[col] = (uchar)run;
    }
}

// For parallel devices, one work-item a cell from begin to before end: the same for both directions, but that whole
// rows count.
kernel void square_bits(global const int *bits, global uchar *runs, const int band, const int cols, const int words,
                        const int begin, const int end) {
    const int col = begin + get_global_id(0), row = get_global_id(1);
    if (row >= band || col >= end) return;
    global const int *line = bits + (long)row * words;
    const long cell = (long)row * cols + col;
    const int right = min(cells_right(line, words, col, LONGEST), cols - col);
    const int left = min(cells_left(line, col, LONGEST), col + 1);
    runs[cell] = (uchar)min(right, LONGEST);
    runs[(long)band * cols + cell] = (uchar)min(left, LONGEST);
}

// For serial devices, one work-item a plane: rows in the order of growth, each from its neighbour row.
kernel void squares_rows(global const uchar *runs, global uchar *squares, const int rows, const int cols,
                         const int first, const int band, const int top, const int left, const int bottom,
                         const int right) {
    const int plane = get_global_id(0), dx = plane & 1 ? -1 : 1, dy = plane & 2 ? -1 : 1;
    global const uchar *run = runs + (long)(plane & 1) * band * cols;
    global uchar *out = squares + (long)plane * (rows + 2) * (cols + 2);
    const int begin_col = reach_begin(dx, left), end_col = reach_end(dx, right, cols);
    const int begin_row = reach_begin(dy, top), end_row = reach_end(dy, bottom, rows);
    for (int i = 0; i < end_row - begin_row; ++i) {
        const int row = dy > 0 ? end_row - 1 - i : begin_row + i;
        global const uchar *row_run = run + (long)(row - first) * cols;
        global const uchar *next = out + padded(row + dy, 0, cols);
        global uchar *here = out + padded(row, 0, cols);
        for (int col = begin_col; col < end_col; ++col) {
            const int side = 1 + min((int)next[col], (int)next[col + dx]);
            here[col] = (uchar)min((int)row_run[col], side);
        }
    }
}

// For parallel devices, one work-item a cell and plane: the same number found by looking along the column. The first
// work-item of a plane has the first of its cells.
kernel void squares_scan(global const uchar *runs, global uchar *squares, const int rows, const int cols,
                         const int first, const int band, const int top, const int left, const int bottom,
                         const int right) {
    const int plane = get_global_id(2), dx = plane & 1 ? -1 : 1, dy = plane & 2 ? -1 : 1;
    const int col = reach_begin(dx, left) + get_global_id(0), row = reach_begin(dy, top) + get_global_id(1);
    if (col >= reach_end(dx, right, cols) || row >= reach_end(dy, bottom, rows)) return;
    global const uchar *run = runs + (long)(plane & 1) * band * cols + (long)(row - first) * cols + col;
    const long next = (long)dy * cols;
    int side = min((int)run[0], dy > 0 ? rows - row : row + 1), i = 1;
    // Four rows between two decisions, so that reads need not wait for one another.
    for (; i + 3 < side; i += 4) {
        const int a = max((int)run[i * next], i), b = max((int)run[(i + 1) * next], i + 1);
        const int c = max((int)run[(i + 2) * next], i + 2), d = max((int)run[(i + 3) * next], i + 3);
        side = min(side, min(min(a, b), min(c, d)));
    }
    for (; i < side; ++i) side = min(side, max((int)run[i * next], i));
    squares[(long)plane * (rows + 2) * (cols + 2) + padded(row, col, cols)] = (uchar)side;
}
