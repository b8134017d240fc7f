// Empty rectangles: for each cell and sector of directions, width and height of a rectangle of free cells; see the
// reference.
// requires: bits

#define LONGEST 255
// The entry of an occupied cell; the ring has 0.
#define OCCUPIED 1
// Capacity of the stack of columns that may bound a rectangle.
#define STACK 256

// Return the index of a cell in a padded plane.
int padded(const int row, const int col, const int cols) { return (row + 1) * (cols + 2) + col + 1; }

// Return the index of a cell in a padded plane of groups of rows, a power of two of them.
int padded_in_groups(const int row, const int col, const int cols, const int group) {
    const int in_group = (row + 1) & (group - 1);
    return (row + 1 - in_group) * (cols + 2) + (col + 1) * group + in_group;
}

// Return the first cell along an axis whose rectangle can contain the cell low or one beyond it. Rectangles extend to
// larger (way 1) or smaller (way -1) indices.
int reach_begin(const int way, const int low) { return way > 0 ? max(low - RECTANGLE_REACH, 0) : low; }

// Return one beyond the last cell whose rectangle can contain a cell before high.
int reach_end(const int way, const int high, const int size) {
    return way > 0 ? high : min(high + RECTANGLE_REACH, size);
}

// Return height and width in the proportion of the ray in the middle of a sector.
int2 slope(const int sectors, const int sector) {
    if (sectors == 1) return (int2)(1, 1);
    if (sectors == 2) return sector == 0 ? (int2)(5, 12) : (int2)(12, 5);
    return sector == 0 ? (int2)(1, 5) : sector == 1 ? (int2)(2, 3) : sector == 2 ? (int2)(3, 2) : (int2)(5, 1);
}

// Count the free cells along columns of the band, to larger rows (direction 0) or smaller rows (direction 1), for
// columns in [begin, end). For processors: one work-item takes 64 columns and a direction.
kernel void free_columns(ARGUMENTS) {
    const int from = begin + 64 * get_global_id(0), direction = get_global_id(1), until = min(from + 64, end);
    global uchar *out = runs + (long)direction * band * cols;
    for (int i = 0; i < band; ++i) {
        const long row = direction ? i : band - 1 - i, before = direction ? row - 1 : row + 1;
        for (int col = from; col < until; ++col) {
            const int run = i == 0 ? 0 : out[before * cols + col];
            out[row * cols + col] = occupied[row * cols + col] ? 0 : (uchar)min(run + 1, LONGEST);
        }
    }
}

// Find the rectangles along rows, from the far end of a row to its begin. For processors: one work-item takes a row and
// quadrant of a world. The widest rectangle of sufficient height is at most one column wider than its neighbour's. The
// stack has the columns that bound its height, each lower than all before it: free cells in the upper 16 bits, and the
// last 16 bits of the column, which give the distance.
kernel void rectangles_rows(ARGUMENTS) {
    const int quadrant = get_global_id(1) & 3, dx = quadrant & 1 ? -1 : 1, dy = quadrant & 2 ? -1 : 1;
    const int w = get_global_id(1) >> 2;
    const int row = reach_begin(dy, top) + get_global_id(0);
    if (row >= reach_end(dy, bottom, rows) || w >= worlds) return;
    global const uchar *run = runs + ((long)((dy > 0 ? 0 : band) + row - first) * worlds + w) * cols;
    global int *waiting = stack + ((long)(row - reach_begin(dy, top)) * 4 * worlds + 4 * w + quadrant) * STACK;
    const int begin = reach_begin(dx, left), end = reach_end(dx, right, cols);
    const int scanned = dx > 0 ? min(end + RECTANGLE_REACH, cols) - begin : end - max(begin - RECTANGLE_REACH, 0);
    for (int sector = 0; sector < sectors; ++sector) {
        const int2 middle = slope(sectors, sector);
        global ushort *out = rectangles + (long)place[w] * 4 * sectors +
                             (long)(quadrant * sectors + sector) * lines * (cols + 2);
        int oldest = 0, newest = 0, width = 0;
        for (int i = 0; i < scanned; ++i) {
            const int col = dx > 0 ? begin + scanned - 1 - i : end - scanned + i, here = run[col];
            while (newest > oldest && waiting[(newest - 1) & (STACK - 1)] >> 16 >= here) --newest;
            waiting[newest++ & (STACK - 1)] = here << 16 | (col & 0xffff);
            int height = LONGEST;
            for (width = min(width + 1, LONGEST); width > 0; --width) {
                while ((dx * (waiting[oldest & (STACK - 1)] - col) & 0xffff) >= width) ++oldest;
                height = waiting[oldest & (STACK - 1)] >> 16;
                if (height * middle.y >= width * middle.x) break;
                height = LONGEST;
            }
            const int other = col + dx * width;
            const int known = width < LONGEST && other >= 0 && other < cols;
            const int lower = known ? min(height, (int)run[other]) : 0;
            const int wider = lower * middle.y > width * middle.x;
            if (col < begin || col >= end) continue;
            const int sides = wider ? width + 1 + 256 * lower : width > 0 ? width + 256 * height : OCCUPIED;
            out[padded_in_groups(row, col, cols, group)] = (ushort)sides;
        }
    }
}

// Count the free cells along rows, to the right (direction 0) and to the left (direction 1), for columns in [begin,
// end). For GPUs: one work-item takes four cells, whose counts differ by one until an occupied cell.
kernel void free_rows(ARGUMENTS) {
    const int from = begin + 4 * get_global_id(0), row = get_global_id(1), last = min(from + 4, end) - 1;
    if (row >= band || from >= end) return;
    global const int *line = bits + (long)row * words;
    const long cell = (long)row * cols, other = (long)band * cols + cell;
    int right = min(cells_right(line, words, last, LONGEST), cols - last);
    int left = min(cells_left(line, from, LONGEST), from + 1);
    uint ahead = 0, behind = 0;
    for (int i = 0; i <= last - from; ++i) {
        const int forward = from + i, back = last - i;
        if (i > 0) right = line[back >> 5] >> (back & 31) & 1 ? 0 : right + 1;
        if (i > 0) left = line[forward >> 5] >> (forward & 31) & 1 ? 0 : left + 1;
        ahead = ahead << 8 | min(right, LONGEST);
        behind |= min(left, LONGEST) << 8 * i;
    }
    global uchar *to = runs + cell + from, *back = runs + other + from;
    if (last - from == 3 && (((size_t)to | (size_t)back) & 3) == 0) {
        *(global uint *)to = ahead, *(global uint *)back = behind;
        return;
    }
    for (int i = 0; i <= last - from; ++i) to[i] = (uchar)(ahead >> 8 * i), back[i] = (uchar)(behind >> 8 * i);
}

// Find the rectangles along columns: the higher a rectangle, the narrower. For GPUs: one work-item takes a sector of
// tall cells of a column in a quadrant, from the far end on, and writes four at once; the last one takes the remaining
// cells, too. Ends of tiles and fours are multiples of four rows of the padded plane. height and width are the sides of the highest rectangle of
// sufficient width, narrower is the width of a rectangle that is one row higher, and bound is the number of rows to the
// nearest row with this width; wider and nearer are the same of the rows before that one, wider is -1 where they are
// unknown. From one cell to the next the height grows by one at most, and its rows without the new row allow every
// smaller height. So the next cell's sides need no other row, unless both rows that bound the width are left behind.
kernel void rectangles_scan(ARGUMENTS) {
    const int quadrant = get_global_id(2) & 3, w = get_global_id(2) >> 2;
    const int dx = quadrant & 1 ? -1 : 1, dy = quadrant & 2 ? -1 : 1;
    const int sector = get_global_id(1) % sectors, tile = get_global_id(1) / sectors;
    const int col = reach_begin(dx, left) + get_global_id(0);
    // Rows of the padded plane.
    const int from = reach_begin(dy, top) + 1, until = reach_end(dy, bottom, rows) + 1;
    const int tiles = max((until - (from & ~3)) / tall, 1), corner = (from & ~3) + tall * tile;
    const int begin = max(corner, from), end = tile == tiles - 1 ? until : corner + tall;
    if (col >= reach_end(dx, right, cols) || w >= worlds || tile >= tiles) return;
    global ushort *out = rectangles + (long)place[w] * 4 * sectors;
    out += (long)(quadrant * sectors + sector) * lines * (cols + 2);
    const int2 middle = slope(sectors, sector);
    const long step = dy * (long)worlds * cols;
    // x * inverse >> 16 is x * middle.x / middle.y for x up to LONGEST.
    const int inverse = middle.x * (65536 / middle.y + 1);
    // Begin at the row before the tile, whose rectangle may have a row less: the next one may have a row more.
    const int before = dy > 0 ? end : begin - 1;
    int height = 0, width = LONGEST, narrower = 0, bound = 0, wider = LONGEST, nearer = 0;
    int room = min(dy > 0 ? rows + 1 - before : before, LONGEST - 1);
    long at = (((long)(quadrant & 1) * band + before - 1 - first) * worlds + w) * cols + col;
    for (;;) {
        narrower = height < room ? min(width, (int)runs[at + height * step]) : 0;
        if (narrower * middle.x < (height + 1) * middle.y) break;
        if (narrower < width) wider = width, nearer = bound, bound = height;
        width = narrower;
        ++height;
    }
    // Rows of a write, less one: a write of four takes no longer than a write of one.
    const int others = group > 1 ? 3 : 0, edge = dy > 0 ? 0 : others, last = dy > 0 ? begin : end - 1;
    ulong four = 0;
    at -= step;
    int next = runs[at];
    for (int row = dy > 0 ? end - 1 : begin;; row -= dy, at -= step) {
        const int here = next, least = min(here, width);
        if (row != last) next = runs[at - step];
        room = min(room + 1, LONGEST);
        const int higher = height < room && least * middle.x >= (height + 1) * middle.y;
        bound = here <= width ? 0 : bound + 1;
        nearer = here <= wider ? 0 : nearer + 1;
        wider = here <= width ? LONGEST : min(here, wider);
        height = higher ? height + 1 : min(height, here * inverse >> 16);
        narrower = height == room ? 0 : higher ? min(here, narrower) : least;
        width = height > 0 ? least : LONGEST;
        if (height > 0 && bound >= height) {
            width = wider, bound = nearer, wider = -1;
            if (width < 0 || bound >= height) {
                width = LONGEST, bound = 0, wider = LONGEST;
                for (int j = 0; j < height; ++j) {
                    const int other = runs[at + j * step];
                    if (other < width) wider = width, nearer = bound, width = other, bound = j;
                }
            }
        }
        const int best = narrower * middle.x > height * middle.y;
        four = four << 16 | (uint)(best ? narrower + 256 * (height + 1) : height > 0 ? width + 256 * height : OCCUPIED);
        if ((row & others) != edge && row != last) continue;
        const int lowest = row & ~others, highest = lowest + others;
        if (others > 0 && lowest >= begin && highest < end) {
            *(global ulong *)(out + padded_in_groups(lowest - 1, col, cols, group)) =
                dy > 0 ? four : as_ulong(as_ushort4(four).wzyx);
        } else {
            const int oldest = dy > 0 ? min(highest, end - 1) : max(lowest, begin);
            for (int k = row; (oldest - k) * dy >= 0; k += dy, four >>= 16)
                out[padded_in_groups(k - 1, col, cols, group)] = (ushort)four;
        }
        if (row == last) return;
    }
}
