// Exact squared Euclidean distance transform in cells (Meijster, Roerdink and Hesselink 2000): all integers.
// A pass works on parallel lines of a grid. Line i starts at i * line_stride; its cells are step apart. The host
// decides which axis goes first, so that neighbouring work-items read neighbouring cells where that pays.

#define NO_OBSTACLE (-1)
#define UNREACHABLE 0x7fffffff

// First pass, one work-item a line: cells to the nearest occupied cell of the same line, NO_OBSTACLE without one.
kernel void distance_lines(global const uchar *occupied, global int *along, const int lines, const int length,
                           const int line_stride, const int step) {
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

// Squared distance from cell i to the obstacle nearest to cell j across the lines.
int parabola(const int i, const int j, const int across) { return (i - j) * (i - j) + across * across; }

// Second pass, one work-item a line: lower envelope of the parabolas of the first pass. The vertices wait in
// squared, which a line overwrites from its far end: entry q of the stack never lies beyond the cell that reads it.
kernel void distance_envelope(global const int *along, global int *starts, global int *squared, const int lines,
                              const int length, const int line_stride, const int step) {
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
