// Quadrant empty squares: for each cell and each of the four diagonal directions, the side of the largest square of
// free cells that has the cell at its corner and grows that way, at most 255. A ray may cross such a square in one
// step without missing an obstacle. Source: anisotropic Chebyshev distance maps (Deakin and Knackstedt 2020).
// Planes are padded by a ring of zeros, so a walk that leaves the grid stops there. Plane q grows to
// (+x, +y), (-x, +y), (+x, -y), (-x, -y) for q = 0, 1, 2, 3.

#define LONGEST 255

int padded(const int row, const int col, const int cols) { return (row + 1) * (cols + 2) + col + 1; }

// One work-item a row and direction: free cells in a row, to the right (direction 0) or left (direction 1).
kernel void square_runs(global const uchar *occupied, global uchar *runs, const int rows, const int cols) {
    const int row = get_global_id(0), leftward = get_global_id(1);
    if (row >= rows) return;
    global uchar *out = runs + (long)leftward * rows * cols + (long)row * cols;
    global const uchar *cell = occupied + (long)row * cols;
    int run = 0;
    for (int i = 0; i < cols; ++i) {
        const int col = leftward ? i : cols - 1 - i;
        run = cell[col] ? 0 : min(run + 1, LONGEST);
        out[col] = (uchar)run;
    }
}

// For serial devices, one work-item a plane: rows in the order of growth, each from its neighbour row.
kernel void squares_rows(global const uchar *runs, global uchar *squares, const int rows, const int cols) {
    const int plane = get_global_id(0), dx = plane & 1 ? -1 : 1, dy = plane & 2 ? -1 : 1;
    global const uchar *run = runs + (long)(plane & 1) * rows * cols;
    global uchar *out = squares + (long)plane * (rows + 2) * (cols + 2);
    for (int i = 0; i < rows; ++i) {
        const int row = dy > 0 ? rows - 1 - i : i;
        global const uchar *row_run = run + (long)row * cols;
        global const uchar *next = out + padded(row + dy, 0, cols);
        global uchar *here = out + padded(row, 0, cols);
        for (int col = 0; col < cols; ++col) {
            const int side = 1 + min((int)next[col], (int)next[col + dx]);
            here[col] = (uchar)min((int)row_run[col], side);
        }
    }
}

// For parallel devices, one work-item a cell and plane: the same number found by looking along the column.
kernel void squares_scan(global const uchar *runs, global uchar *squares, const int rows, const int cols) {
    const int cell = get_global_id(0), plane = get_global_id(1), dy = plane & 2 ? -1 : 1;
    if (cell >= rows * cols) return;
    const int row = cell / cols, col = cell % cols;
    global const uchar *run = runs + (long)(plane & 1) * rows * cols + col;
    int side = run[(long)row * cols];
    for (int i = 1; i < side; ++i) {
        const int other = row + i * dy;
        if (other < 0 || other >= rows) {
            side = i;
            break;
        }
        side = min(side, max((int)run[(long)other * cols], i));
    }
    squares[(long)plane * (rows + 2) * (cols + 2) + padded(row, col, cols)] = (uchar)side;
}
