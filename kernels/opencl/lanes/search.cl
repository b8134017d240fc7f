// Exhaustive search over poses: sums at LANES neighbouring shifts at once. search.cl has the other kernels.
// requires: lanes/types score_cells

// Sum the cells of each item's runs at all shifts by less than height rows and width columns; a shift that is not allowed
// has -1. One work-item takes SHIFT_ROWS rows of LANES shifts of an item. A sum of 256 cells fits 16 bits.
kernel void shift_scores(ARGUMENTS) {
    const int col = LANES * get_global_id(0), row = SHIFT_ROWS * get_global_id(1), item = begin + get_global_id(2);
    if (col >= width || row >= height || item >= items) return;
    int some = 0;
    for (int i = 0; i < SHIFT_ROWS && row + i < height; ++i)
        for (int j = 0; j < LANES && col + j < width; ++j) some |= allowed[(row + i) * width + col + j];
    const int stride = padded_stride(scores), size = padded_lines(scores) * stride;
    const int last = first[item] + (some ? runs[item] : 0);
    uint total[SHIFT_ROWS][LANES] = {{0}};
    for (int k = first[item]; k < last;) {
        ushort8 even[SHIFT_ROWS], odd[SHIFT_ROWS];
        for (int i = 0; i < SHIFT_ROWS; ++i) even[i] = odd[i] = (ushort8)0;
        for (int summed = 0; k < last && summed + weight[k] <= 256; ++k) {
            const ushort8 times = (ushort8)(ushort)weight[k];
            global const uchar *cells = table + image[k] * size +
                                        block_index(scores, run[k].y + row, run[k].x + col, SHIFT_ROWS - 1, LANES - 1);
            // Two neighbouring bytes are one number of 16 bits, so that no byte is converted.
            for (int i = 0; i < SHIFT_ROWS; ++i) {
                const ushort8 two = as_ushort8(vload16(0, cells + i * stride));
                even[i] += times * (two & (ushort8)0xff);
                odd[i] += times * (two >> (ushort8)8);
            }
            summed += weight[k];
        }
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
    for (int i = 0; i < SHIFT_ROWS && row + i < height; ++i)
        for (int j = 0; j < LANES && col + j < width; ++j) {
            const int n = (row + i) * width + col + j;
            score[item * height * width + n] = allowed[n] ? (int)total[i][j] : -1;
        }
}
