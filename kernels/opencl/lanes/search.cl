// Exhaustive search over poses: sums at LANES neighbouring shifts at once. search.cl has the other kernels.
// requires: lanes/types score_cells

// A vector at any address; PoCL compiles vload16 as a call.
typedef uint4 unaligned __attribute__((aligned(1)));

// Sum the losses of each item's points at all shifts by less than height rows and width columns, and write the scores; a
// shift that is not allowed has -1. One work-item takes SHIFT_ROWS rows of LANES shifts of an item. The losses of together
// points fit a byte, and those of 256 times as many points fit 16 bits.
kernel void shift_scores(ARGUMENTS) {
    const int col = LANES * get_global_id(0), row = SHIFT_ROWS * get_global_id(1), item = begin + get_global_id(2);
    if (col >= width || row >= height || item >= items) return;
    int some = 0;
    for (int i = 0; i < SHIFT_ROWS && row + i < height; ++i)
        for (int j = 0; j < LANES && col + j < width; ++j) some |= allowed[(row + i) * width + col + j];
    const int stride = padded_stride(scores), size = padded_lines(scores) * stride, together = 255 / (TOP / unit);
    const int last = some ? first[item + 1] : first[item];
    uint total[SHIFT_ROWS][LANES] = {{0}};
    for (int k = first[item]; k < last;) {
        ushort8 even[SHIFT_ROWS], odd[SHIFT_ROWS];
#pragma unroll
        for (int i = 0; i < SHIFT_ROWS; ++i) even[i] = odd[i] = (ushort8)0;
        for (int round = 0; round < 256 && k < last; ++round) {
            uint4 few[SHIFT_ROWS];
#pragma unroll
            for (int i = 0; i < SHIFT_ROWS; ++i) few[i] = (uint4)0;
            const int stop = last - k > together ? k + together : last;
            for (; k < stop; ++k) {
                global const uchar *cells = table + image[k] * size +
                                            block_index(scores, point[k].y + row, point[k].x + col, SHIFT_ROWS - 1, LANES - 1);
#pragma unroll
                for (int i = 0; i < SHIFT_ROWS; ++i) few[i] += *(global const unaligned *)(cells + i * stride);
            }
            // Two neighbouring bytes are one number of 16 bits, so that no byte is converted.
#pragma unroll
            for (int i = 0; i < SHIFT_ROWS; ++i) {
                even[i] += as_ushort8(few[i]) & (ushort8)0xff;
                odd[i] += as_ushort8(few[i]) >> (ushort8)8;
            }
        }
#pragma unroll
        for (int i = 0; i < SHIFT_ROWS; ++i) {
            ushort evens[8], odds[8];
            vstore8(even[i], 0, evens);
            vstore8(odd[i], 0, odds);
            for (int j = 0; j < 8; ++j) {
                total[i][2 * j] += evens[j];
                total[i][2 * j + 1] += odds[j];
            }
        }
    }
    const int most = TOP * (last - first[item]);
    for (int i = 0; i < SHIFT_ROWS && row + i < height; ++i)
        for (int j = 0; j < LANES && col + j < width; ++j) {
            const int n = (row + i) * width + col + j;
            score[item * height * width + n] = allowed[n] ? most - unit * (int)total[i][j] : -1;
        }
}
