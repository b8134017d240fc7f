// Exact squared Euclidean distance transform in cells (Meijster, Roerdink and Hesselink 2000), in integers. On
// processors a work-item takes a line, in time linear in its length. Lines of a pass are parallel: line i starts at i *
// line_stride, and its cells are step apart. GPUs need more work-items than a map has lines: on a GPU a work-item takes
// a cell, and stops its search around the cell once no nearer obstacle is possible.
// requires: bits

#define NO_OBSTACLE (-1)
#define UNREACHABLE 0x7fffffff

// First pass: count the cells to the nearest occupied cell of the same line, NO_OBSTACLE without one. One work-item
// takes a line.
kernel void distance_lines(ARGUMENTS) {
    const int line = get_global_id(0);
    if (line >= lines) return;
    global const uchar *cell = occupied + (long)line * line_stride;
    global int *out = along + (long)line * line_stride;
    int nearest = NO_OBSTACLE;
    for (int i = 0; i < length; ++i) {
        if (cell[(long)i * step]) nearest = i;
        out[(long)i * step] = nearest == NO_OBSTACLE ? NO_OBSTACLE : i - nearest;
    }
    nearest = NO_OBSTACLE;
    for (int i = length - 1; i >= 0; --i) {
        if (cell[(long)i * step]) nearest = i;
        if (nearest == NO_OBSTACLE) continue;
        const int before = out[(long)i * step], after = nearest - i;
        if (before == NO_OBSTACLE || after < before) out[(long)i * step] = after;
    }
}

// Return the squared distance from cell i to the obstacle nearest to cell j across the lines.
int parabola(const int i, const int j, const int across) { return (i - j) * (i - j) + across * across; }

// Second pass: evaluate the lower envelope of the parabolas of the first pass. One work-item takes a line. The stack of
// vertices shares squared, overwritten from its far end: entry q of the stack never passes the cell that reads it.
kernel void distance_envelope(ARGUMENTS) {
    const int line = get_global_id(0);
    if (line >= lines) return;
    global const int *across = along + (long)line * line_stride;
    global int *start = starts + (long)line * line_stride;
    global int *vertex = squared + (long)line * line_stride;
    int top = -1;
    for (int i = 0; i < length; ++i) {
        const int g = across[(long)i * step];
        if (g == NO_OBSTACLE) continue;
        int begin = 0;
        while (top >= 0) {
            const int v = vertex[(long)top * step], gv = across[(long)v * step], s = start[(long)top * step];
            if (parabola(s, v, gv) <= parabola(s, i, g)) {
                begin = (i * i - v * v + g * g - gv * gv) / (2 * (i - v)) + 1;
                break;
            }
            --top;
        }
        if (begin >= length) continue;
        ++top;
        vertex[(long)top * step] = i;
        start[(long)top * step] = top == 0 ? 0 : begin;
    }
    for (int i = length - 1; i >= 0; --i) {
        if (top < 0) {
            vertex[(long)i * step] = UNREACHABLE;
            continue;
        }
        const int v = vertex[(long)top * step], s = start[(long)top * step];
        vertex[(long)i * step] = parabola(i, v, across[(long)v * step]);
        if (s == i) --top;
    }
}

// ---- kernels with a work-item per cell

// Larger than all distances. Its square plus the square of a distance fits into 32 unsigned bits.
#define FAR 46341
#define BLOCK_BITS 5
#define BLOCK_ROWS (1 << BLOCK_BITS)
// Rows read between two decisions, so that reads do not wait for each other.
#define STEP_ROWS 4

// First pass: count the cells to the nearest occupied cell of the same row, FAR where it is over reach. One work-item
// takes a cell.
kernel void distance_bits(ARGUMENTS) {
    const int col = get_global_id(0), row = get_global_id(1);
    if (row >= rows || col >= cols) return;
    global const int *line = bits + (long)row * words;
    const int left = cells_left(line, col, reach);
    const int cells = min(left, cells_right(line, words, col, min(left, reach)));
    nearest[(long)row * cols + col] = (ushort)(cells > reach ? FAR : cells);
}

// Find the minimum of each column of a block of rows. One work-item takes a column of a block.
kernel void distance_blocks(ARGUMENTS) {
    const int col = get_global_id(0), block = get_global_id(1);
    if (block >= count || col >= cols) return;
    const int last = min((block + 1) * BLOCK_ROWS, rows);
    int least = FAR;
    for (int row = block * BLOCK_ROWS; row < last; ++row) least = min(least, (int)nearest[(long)row * cols + col]);
    blocks[(long)block * cols + col] = (ushort)least;
}

// Return the sum of two squares.
uint squares_sum(const uint a, const uint b) { return a * a + b * b; }

// Second pass: find the least sum of squares along the column of a cell, UNREACHABLE where it is over most. One
// work-item takes a cell. Near rows are read singly. Farther away, the minima of blocks give an upper bound first, and
// then the blocks that may hold less.
kernel void distance_search(ARGUMENTS) {
    const int col = get_global_id(0), row = get_global_id(1);
    if (row >= rows || col >= cols) return;
    global const ushort *column = nearest + col, *block = blocks + col;
    // One more than the largest result.
    uint best = min(squares_sum(0, column[(long)row * cols]), (uint)most + 1);
    int i = 1;
    for (; i <= BLOCK_ROWS && (uint)(i * i) < best; i += STEP_ROWS) {
        for (int j = i; j < i + STEP_ROWS; ++j) {
            if (j <= row) best = min(best, squares_sum(j, column[(long)(row - j) * cols]));
            if (row + j < rows) best = min(best, squares_sum(j, column[(long)(row + j) * cols]));
        }
    }
    // Blocks begin beyond the rows read so far, so all rows of a block are on one side.
    for (int pass = (uint)(i * i) < best ? 0 : 2; pass < 2; ++pass) {
        for (int way = -1; way <= 1; way += 2) {
            for (int b = (row + way * i) >> BLOCK_BITS; b >= 0 && b < count; b += way) {
                const int begin = b * BLOCK_ROWS, end = min(begin + BLOCK_ROWS, rows) - 1;
                const int near = max(way > 0 ? begin - row : row - end, i), far = way > 0 ? end - row : row - begin;
                if ((uint)(near * near) >= best) break;
                const uint least = block[(long)b * cols];
                if (pass == 0) best = min(best, squares_sum(far, least) + 1);
                if (pass == 0 || squares_sum(near, least) >= best) continue;
                for (int j = near; j <= far; ++j) best = min(best,
                                                             squares_sum(j, column[(long)(row + way * j) * cols]));
            }
        }
    }
    squared[(long)row * cols + col] = best > (uint)most ? UNREACHABLE : (int)best;
}

// ---- table of a likelihood field

// Fill width x height cells of a field's table from squared distances: density has a value for each squared distance
// up to the cap. The cells begin at index begin of the table and at cell (from_col, from_row) of the grid; cells
// outside the grid get beyond.
kernel void fill_field(ARGUMENTS) {
    const int i = get_global_id(0), j = get_global_id(1), col = from_col + i, row = from_row + j;
    if (i >= width || j >= height) return;
    const int inside = col >= 0 && col < cols && row >= 0 && row < rows;
    table[begin + (long)j * stride + i] = inside ? density[min(squared[(long)row * cols + col], cap)] : beyond;
}
