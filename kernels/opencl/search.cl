// Exhaustive search over poses: sums of a table's cells over the end points of a scan; see the reference.
// requires: score_cells

// Points after which sums are compared, and points whose losses fit 15 bits.
#if READ_AHEAD
#define STEP 16
#else
#define STEP 24
#endif
#define TOGETHER 128
// Numbers that count the lines of a scan by their scores.
#define BINS 512
// The distance of a shift from the first one of its line: lines are rows on processors.
#if READ_AHEAD
#define ALONG(i) ((i) * along)
#else
#define ALONG(i) (i)
#endif

// Return the scores of a block's quarters: score less the losses of every apart-th point from begin to end - 1. Once all are
// below least, the other points are left out. The columns of a table lie across on GPUs, see fold_quarters of score_tables.
int4 divided(global const int *quarters, global const int2 *point, global const int *image, const ScoreTable scores,
             const int begin, const int end, const int apart, const int row, const int col, const int score, const int least,
             const int across) {
    const int lines = padded_lines(scores), stride = padded_stride(scores);
#if READ_AHEAD
    const int down = across ? 1 : stride, right = across ? lines : 1;
#else
    const int down = stride, right = 1;
#endif
    int4 total = (int4)(score);
    for (int k = begin; k < end;) {
        const int stop = end - k > STEP * apart ? k + STEP * apart : end;
        // Two sums of 16 bits in a number.
        int even = 0, odd = 0;
#if READ_AHEAD
#pragma unroll 8
#else
        // A processor computes the places of eight points at once, and waits for several cells at a time.
        int8 evens = 0, odds = 0;
        for (; k + 8 <= stop; k += 8) {
            const int8 at = block_indices(point + k, image + k, scores, row, col, 0, 0);
            const int8 four = (int8)(quarters[at.s0], quarters[at.s1], quarters[at.s2], quarters[at.s3], quarters[at.s4],
                                     quarters[at.s5], quarters[at.s6], quarters[at.s7]);
            evens += four & 0xff00ff;
            odds += four >> 8 & 0xff00ff;
        }
        for (int i = 0; i < 8; ++i) {
            even += ((const int *)&evens)[i];
            odd += ((const int *)&odds)[i];
        }
#endif
        for (; k < stop; k += apart) {
            const int line = within(point[k].y + row + scores.margin, lines - 1);
            const int four = quarters[image[k] + line * down + within(point[k].x + col + scores.margin, stride - 1) * right];
            even += four & 0xff00ff;
            odd += four >> 8 & 0xff00ff;
        }
        total -= (int4)(even & 0xffff, odd & 0xffff, even >> 16, odd >> 16);
        if (total.x < least && total.y < least && total.z < least && total.w < least) break;
    }
    return total;
}

#if IN_TEAMS
// Work-items that share the points of a block.
#define TEAM 32

// Return the scores of a block's quarters from those that the members of a team have left of the block's score.
int4 left_by_team(local int4 *shared, const int4 own, const int score) {
    const int member = get_local_id(0);
    barrier(CLK_LOCAL_MEM_FENCE);
    shared[member] = own - score;
    for (int apart = TEAM / 2; apart > 0; apart /= 2) {
        barrier(CLK_LOCAL_MEM_FENCE);
        if (member < apart) shared[member] += shared[member + apart];
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    return shared[0] + score;
}
#endif

// Sum the losses of each item's points at all shifts by less than height rows and width columns, and write the scores; a
// shift that is not allowed has -1. One work-item takes SHIFT_ROWS rows of a column of an item.
kernel void shift_scores(ARGUMENTS) {
    const int col = get_global_id(0), row = SHIFT_ROWS * get_global_id(1), item = get_global_id(2);
    if (col >= width || row >= height || item >= items) return;
    int some = 0;
    for (int i = 0; i < SHIFT_ROWS && row + i < height; ++i) some |= allowed[(row + i) * width + col];
    const int stride = padded_stride(scores), last = some ? first[item + 1] : first[item];
    int total[SHIFT_ROWS] = {0};
    for (int k = first[item]; k < last;) {
        const int stop = last - k > TOGETHER ? k + TOGETHER : last;
        // Two sums of 16 bits in a number.
        uint even[SHIFT_ROWS / 4] = {0}, odd[SHIFT_ROWS / 4] = {0};
        for (; k < stop; ++k) {
            global const int *cells =
                table + image[k] + block_index(scores, point[k].y + row, point[k].x + col, SHIFT_ROWS - 1, 0);
            for (int i = 0; i < SHIFT_ROWS / 4; ++i) {
                const uint four = cells[4 * i * stride];
                even[i] += four & 0xff00ff;
                odd[i] += four >> 8 & 0xff00ff;
            }
        }
        for (int i = 0; i < SHIFT_ROWS / 4; ++i) {
            total[4 * i] += even[i] & 0xffff;
            total[4 * i + 1] += odd[i] & 0xffff;
            total[4 * i + 2] += even[i] >> 16;
            total[4 * i + 3] += odd[i] >> 16;
        }
    }
    // A loop of SHIFT_ROWS steps keeps the sums in registers.
    for (int i = 0; i < SHIFT_ROWS; ++i) {
        if (row + i >= height) continue;
        const int n = (row + i) * width + col;
        score[item * height * width + n] = allowed[n] ? TOP * (last - first[item]) - unit * total[i] : -1;
    }
}

// Find the largest score of each line of shifts and its first shift, and count the lines of each scan by their scores,
// divided by 2^shift. The caller clears the counts. The lines of an item begin spacing shifts apart, and have length shifts,
// along apart: they are rows on processors, which make vectors of one, and columns on GPUs, whose neighbours read
// neighbours. One work-item takes a line of an item.
kernel void line_maxima(ARGUMENTS) {
    const int n = get_global_id(0);
    if (n >= all) return;
    int most = -1, place = 0;
#if READ_AHEAD
    global const int *mine = score + n / lines * lines * length + n % lines * spacing;
    for (int i = 0; i < length; ++i) {
        place = mine[ALONG(i)] > most ? i : place;
        most = mine[ALONG(i)] > most ? mine[ALONG(i)] : most;
    }
#else
    // Two loops, since compilers make vector code of the first one.
    global const int *mine = score + n * length;
    for (int i = 0; i < length; ++i) most = mine[ALONG(i)] > most ? mine[ALONG(i)] : most;
    while (mine[ALONG(place)] < most) ++place;
#endif
    best[2 * n] = most;
    best[2 * n + 1] = n % lines * spacing + ALONG(place);
    if (most >= 0) atomic_add(&histogram[n / (lines * turns) * BINS + (most >> shift)], 1);
}

// Return the least score, divided by 2^shift, of a scan's most lines with the largest scores, and of others as good.
int promising(global const int *histogram, const int most) {
    int bin = BINS - 1;
    for (int lines = histogram[bin]; lines < most && bin > 0; lines += histogram[--bin]);
    return bin;
}

// Count the promising lines of each item. One work-item takes an item.
kernel void count_promising(ARGUMENTS) {
    const int item = get_global_id(0);
    if (item >= items) return;
    const int least = promising(histogram + item / turns * BINS, most) << shift;
    int some = 0;
    for (int line = 0; line < lines; ++line) some += best[2 * (item * lines + line)] >= least;
    number[item] = some;
}

// Take most of the promising lines of each scan, evenly spaced: many bounds are equal, most of all the largest. Their best
// blocks follow each other as item, first row and column, and score; blocks that are missing have the score -1. One
// work-item takes an item.
kernel void pick_blocks(ARGUMENTS) {
    const int item = get_global_id(0);
    if (item >= items) return;
    const int scan = item / turns, least = promising(histogram + scan * BINS, most) << shift;
    int before = 0, total = 0;
    for (int other = scan * turns; other < (scan + 1) * turns; ++other) {
        before += other < item ? number[other] : 0;
        total += number[other];
    }
    const long taken = min(total, most);
    for (int i = item % turns; i < most; i += turns)
        if (i >= taken) block[4 * (scan * most + i) + 3] = -1;
    for (int line = 0; line < lines; ++line) {
        const int value = best[2 * (item * lines + line)];
        if (value < least) continue;
        const int i = (int)((before * taken + total - 1) / total);
        if (i < taken && i * (long)total / taken == before) {
            global int *out = block + 4 * (scan * most + i);
            out[0] = item;
            out[1] = best[2 * (item * lines + line) + 1] / width << level;
            out[2] = best[2 * (item * lines + line) + 1] % width << level;
            out[3] = value;
        }
        ++before;
    }
}

// Raise the least scores of scans to the scores of poses less their slack. One work-item takes a pose.
kernel void raise_low(ARGUMENTS) {
    const int n = get_global_id(0);
    if (n >= blocks || block[4 * n + 3] < 0) return;
    const int scan = n / most;
    atomic_max(&low[scan], block[4 * n + 3] - slack[scan]);
}

// Collect the shifts whose scores are at least low of their scan, in no certain order: item, first row and column of each
// block, and score. count[level], which the caller clears, may exceed room: then some are left out. best is the result of
// line_maxima. One work-item takes a line of an item.
kernel void choose_blocks(ARGUMENTS) {
    const int k = get_global_id(0);
    if (k >= all) return;
    const int item = k / lines, least = low[item / turns], begin = k % lines * spacing;
    if (best[2 * k] < least) return;
    global const int *mine = score + item * lines * length + begin;
    // A single addition for the whole line.
    int some = 0;
    for (int i = 0; i < length; ++i) some += mine[ALONG(i)] >= least;
    int n = atomic_add(&count[level], some);
    const int row = begin / width, col = begin % width, down = along / width, right = along % width;
    for (int i = 0; i < length && n < room; ++i) {
        const int value = mine[ALONG(i)];
        if (value < least) continue;
        block[4 * n] = item;
        block[4 * n + 1] = row + i * down << level;
        block[4 * n + 2] = col + i * right << level;
        block[4 * n + 3] = value;
        ++n;
    }
}

// Replace blocks of positions by their best allowed quarters of 2^level x 2^level, the first of equal ones; a block without
// an allowed quarter has the score -1. Cells of the quarters are spacing apart for every 2^shift positions. One work-item,
// or with IN_TEAMS a team of them, takes a block.
kernel void follow_blocks(ARGUMENTS) {
#if IN_TEAMS
    local int4 shared[TEAM];
    const int n = get_group_id(0), member = get_local_id(0), members = TEAM;
#else
    const int n = get_global_id(0), member = 0, members = 1;
#endif
    if (n >= blocks || block[4 * n + 3] < 0) return;
    const int item = block[4 * n], row = block[4 * n + 1], col = block[4 * n + 2], quarter = 1 << level;
    int4 sums = divided(quarters, point, image, scores, first[item] + member, first[item + 1], members,
                        spacing * (row >> shift), spacing * (col >> shift), block[4 * n + 3], -1, across);
#if IN_TEAMS
    sums = left_by_team(shared, sums, block[4 * n + 3]);
#endif
    if (member > 0) return;
    const int total[4] = {sums.x, sums.y, sums.z, sums.w};
    int most = -1;
    for (int i = 0; i < 4; ++i) {
        const int part_row = row + i / 2 * quarter, part_col = col + i % 2 * quarter;
        if (part_row >= height || part_col >= width || total[i] <= most) continue;
        if (!allowed[(part_row >> level) * columns + (part_col >> level)]) continue;
        most = total[i];
        block[4 * n + 1] = part_row;
        block[4 * n + 2] = part_col;
    }
    block[4 * n + 3] = most;
}

// Divide count[level + 1] blocks of positions, but at most some from begin on, into quarters of 2^level x 2^level, and
// collect the allowed ones whose scores are at least low of their scan, in no certain order. count[level], which the caller
// clears, may exceed room: then some are left out. Of workers work-items each takes run neighbouring blocks at a time; with
// IN_TEAMS a team shares a block where there are few blocks.
kernel void divide_blocks(ARGUMENTS) {
    if (get_global_id(0) >= workers) return;
    const int left = count[level + 1] - begin, blocks = left < some ? left : some, quarter = 1 << level;
#if IN_TEAMS
    local int4 shared[TEAM];
    const int members = blocks < workers / 4 ? TEAM : 1, member = get_local_id(0) % members;
#else
    const int members = 1, member = 0;
#endif
    const int each = workers / members;
    for (int n = run * (get_global_id(0) / members); n < blocks; n += n % run == run - 1 ? run * (each - 1) + 1 : 1) {
        global const int *here = block + 4 * (begin + n);
        const int item = here[0], row = here[1], col = here[2], least = low[item / turns];
        const int line = spacing * (row >> shift), aside = spacing * (col >> shift), last = first[item + 1];
        int4 sums;
        // Two calls, so that the compiler knows how far points are apart.
#if IN_TEAMS
        if (members > 1) {
            sums = divided(quarters, point, image, scores, first[item] + member, last, TEAM, line, aside, here[3], least, across);
            sums = left_by_team(shared, sums, here[3]);
        } else
#endif
            sums = divided(quarters, point, image, scores, first[item], last, 1, line, aside, here[3], least, across);
        if (member > 0) continue;
        const int total[4] = {sums.x, sums.y, sums.z, sums.w};
        for (int i = 0; i < 4; ++i) {
            const int part_row = row + i / 2 * quarter, part_col = col + i % 2 * quarter;
            if (part_row >= height || part_col >= width || total[i] < least) continue;
            if (!allowed[(part_row >> level) * columns + (part_col >> level)]) continue;
            const int m = atomic_add(&count[level], 1);
            if (m >= room) continue;
            part[4 * m] = item;
            part[4 * m + 1] = part_row;
            part[4 * m + 2] = part_col;
            part[4 * m + 3] = total[i];
        }
    }
}
