// Exhaustive search over poses: sums at RUN neighbouring shifts at once. search.cl has the other kernels.
// requires: score_cells

// A vector of RUN bytes at any address; PoCL compiles loads of vectors as calls.
typedef uint8 unaligned __attribute__((aligned(1)));
#define RUN_AT(cells) (*(global const unaligned *)(cells))

// Add bytes to sums of 16 bits: two neighbouring bytes are one number of 16 bits, so that no byte is converted.
void add_run(ushort16 *even, ushort16 *odd, const uint8 bytes) {
    *even += as_ushort16(bytes) & (ushort16)0xff;
    *odd += as_ushort16(bytes) >> (ushort16)8;
}

// Sum the losses of each item's points at all shifts by less than height rows and width columns, and write the scores; a
// shift that is not allowed has -1. One work-item takes SHIFT_ROWS rows of RUN shifts of an item. The losses of 256 points fit
// 16 bits. The table holds bytes.
kernel void shift_scores(ARGUMENTS) {
    const int col = RUN * get_global_id(0), row = SHIFT_ROWS * get_global_id(1), item = get_global_id(2);
    if (col >= width || row >= height || item >= items) return;
    const int rows = height - row < SHIFT_ROWS ? height - row : SHIFT_ROWS, cols = width - col < RUN ? width - col : RUN;
    int some = 0;
    for (int i = 0; i < rows; ++i)
        for (int j = 0; j < cols; ++j) some |= allowed[(row + i) * width + col + j];
    const int stride = padded_stride(scores), last = some ? first[item + 1] : first[item];
    global const uchar *cells = (global const uchar *)table;
    uint total[SHIFT_ROWS][RUN] = {{0}};
    for (int k = first[item]; k < last;) {
        ushort16 even[SHIFT_ROWS], odd[SHIFT_ROWS];
#pragma unroll
        for (int i = 0; i < SHIFT_ROWS; ++i) even[i] = odd[i] = (ushort16)0;
        const int stop = last - k > 256 ? k + 256 : last;
        for (; unit >= FEW && k + 8 <= stop; k += 8) {
            const int8 at = block_indices(point + k, image + k, scores, row, col, SHIFT_ROWS - 1, RUN - 1);
#pragma unroll
            for (int i = 0; i < SHIFT_ROWS; ++i) {
                global const uchar *here = cells + i * stride;
                add_run(&even[i], &odd[i], RUN_AT(here + at.s0) + RUN_AT(here + at.s1) + RUN_AT(here + at.s2) + RUN_AT(here + at.s3));
                add_run(&even[i], &odd[i], RUN_AT(here + at.s4) + RUN_AT(here + at.s5) + RUN_AT(here + at.s6) + RUN_AT(here + at.s7));
            }
        }
        for (; k < stop; ++k) {
            global const uchar *here =
                cells + image[k] + block_index(scores, point[k].y + row, point[k].x + col, SHIFT_ROWS - 1, RUN - 1);
#pragma unroll
            for (int i = 0; i < SHIFT_ROWS; ++i) add_run(&even[i], &odd[i], RUN_AT(here + i * stride));
        }
#pragma unroll
        for (int i = 0; i < SHIFT_ROWS; ++i) {
            ushort evens[RUN / 2], odds[RUN / 2];
            vstore16(even[i], 0, evens);
            vstore16(odd[i], 0, odds);
            for (int j = 0; j < RUN / 2; ++j) {
                total[i][2 * j] += evens[j];
                total[i][2 * j + 1] += odds[j];
            }
        }
    }
    const int most = TOP * (last - first[item]);
    for (int i = 0; i < rows; ++i) {
        global const uchar *may = allowed + (row + i) * width + col;
        global int *made = score + (item * height + row + i) * width + col;
        for (int j = 0; j < cols; ++j) made[j] = may[j] ? most - unit * (int)total[i][j] : -1;
    }
}
