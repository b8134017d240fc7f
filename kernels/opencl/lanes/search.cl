// Exhaustive search over poses: sums at LANES neighbouring shifts at once. The other kernels are those of search.cl.
// requires: lanes/types score_cells

// Sum the cells of each item's points at all shifts by less than height rows and width columns. One work-item takes
// LANES shifts of an item. A sum of 256 cells fits 16 bits.
kernel void shift_scores(ARGUMENTS) {
    const int col = LANES * get_global_id(0), row = get_global_id(1), item = get_global_id(2);
    if (col >= width || row >= height || item >= items) return;
    const int size = padded_lines(scores) * padded_stride(scores), last = first[item + 1];
    uint total[LANES] = {0};
    for (int begin = first[item]; begin < last; begin += 256) {
        const int end = begin + 256 < last ? begin + 256 : last;
        // Two neighbouring bytes are one number of 16 bits, so that no byte is converted.
        ushort8 even = (ushort8)0, odd = (ushort8)0;
        for (int k = begin; k < end; ++k) {
            global const uchar *cells = table + image[k] * size;
            const ushort8 two = as_ushort8(vload16(0, cells + cell_index(scores, point[k].y + row, point[k].x + col)));
            even += two & (ushort8)0xff;
            odd += two >> (ushort8)8;
        }
        ushort evens[8], odds[8];
        vstore8(even, 0, evens);
        vstore8(odd, 0, odds);
        for (int i = 0; i < 8; ++i) {
            total[2 * i] += evens[i];
            total[2 * i + 1] += odds[i];
        }
    }
    global int *out = score + (item * height + row) * width + col;
    for (int i = 0; i < LANES && col + i < width; ++i) out[i] = total[i];
}
