// Exhaustive search over poses: sums at LANES neighbouring shifts at once. The other kernels are those of search.cl.
// requires: lanes/types score_cells

// Sum the cells of each item's points at all shifts by less than height rows and width columns. One work-item takes
// LANES shifts of an item. A sum of 256 cells fits 16 bits.
kernel void shift_scores(global const uchar *table, global const int2 *point, global const int *image,
                         global const int *first, global int *score, const ScoreTable scores, const int items,
                         const int height, const int width) {
    const int col = LANES * get_global_id(0), row = get_global_id(1), item = get_global_id(2);
    if (col >= width || row >= height || item >= items) return;
    const int size = padded_lines(scores) * padded_stride(scores), last = first[item + 1];
    ilanes total = (ilanes)0;
    for (int begin = first[item]; begin < last; begin += 256) {
        const int end = min(begin + 256, last);
        ushort16 sum = (ushort16)0;
        for (int k = begin; k < end; ++k) {
            global const uchar *cells = table + image[k] * size;
            sum += convert_ushort16(vload16(0, cells + cell_index(scores, point[k].y + row, point[k].x + col)));
        }
        total += convert_int16(sum);
    }
    global int *out = score + (item * height + row) * width + col;
    if (col + LANES <= width) {
        vstore16(total, 0, out);
        return;
    }
    int single[LANES];
    vstore16(total, 0, single);
    for (int i = 0; col + i < width; ++i) out[i] = single[i];
}
