"""Exhaustive search over poses: sums of a table's cells over the end points of a scan."""

import warp as wp

from gpusense.interface.constants import SHIFT_ROWS, TOP

from .flags import IN_TEAMS
from .prelude import kernel, on_gpu, reader, work_item
from .score_cells import ScoreTable, block_index, padded_lines, padded_stride, within

number_at, cell_at = reader(wp.int32), reader(wp.vec2i)
# Sums of neighbouring rows.
Rows = wp.types.vector(length=SHIFT_ROWS, dtype=wp.int32)
# Points after which sums are compared, points that are read together, and points whose losses fit 15 bits.
STEP = 16
AT_ONCE = 8
TOGETHER = 128
# Numbers that count the lines of a scan by their scores.
BINS = 512


@wp.func
def divided(
    quarters: wp.array(dtype=wp.int32), point: wp.array(dtype=wp.vec2i), image: wp.array(dtype=wp.int32),
    scores: ScoreTable, begin: wp.int32, end: wp.int32, apart: wp.int32, row: wp.int32, col: wp.int32, score: wp.int32,
    least: wp.int32, across: wp.int32,
):  # fmt: skip
    """Return the scores of a block's quarters: score less the losses of every apart-th point from begin to end - 1."""
    lines = padded_lines(scores)
    stride = padded_stride(scores)
    down = int(stride)
    right = int(1)
    if across != 0:
        down = int(1)
        right = lines
    total = wp.vec4i(score, score, score, score)
    k = int(begin)
    while k < end:
        stop = wp.min(k + STEP * apart, end)
        # Two sums of 16 bits in a number.
        even = int(0)
        odd = int(0)
        while k < stop:
            for i in range(AT_ONCE):
                n = wp.min(k + i * apart, stop - 1)
                cell = cell_at(point, n)
                line = within(cell.y + row + scores.margin, lines - 1)
                aside = within(cell.x + col + scores.margin, stride - 1)
                four = number_at(quarters, number_at(image, n) + line * down + aside * right)
                if k + i * apart >= stop:
                    four = int(0)
                even = even + (four & 0xFF00FF)
                odd = odd + ((four >> 8) & 0xFF00FF)
            k = k + AT_ONCE * apart
        total = total - wp.vec4i(even & 0xFFFF, odd & 0xFFFF, even >> 16, odd >> 16)
        if wp.max(total) < least:
            k = end
    return total


# Work-items that share a block: a warp with IN_TEAMS. On processors the first of them takes all points.
TEAM = 1


if IN_TEAMS:
    TEAM = 32
_LEFT_BY_TEAM = """
#if defined(__CUDA_ARCH__)
wp::vec_t<4, int> left = own;
for (int i = 0; i < 4; ++i) {
    int total = own.c[i] - score;
    for (int apart = 16; apart > 0; apart /= 2) total += __shfl_xor_sync(0xffffffff, total, apart);
    left.c[i] = score + total;
}
return left;
#else
return own;
#endif
"""


# Return the scores of a block's quarters from those that the members of a team have left of the block's score.
@wp.func_native(_LEFT_BY_TEAM)
def left_by_team(own: wp.vec4i, score: wp.int32) -> wp.vec4i: ...


@kernel
def shift_scores(table, point, image, first, allowed, score, scores, items, height, width, unit):
    """Sum the losses of each item's points at all shifts, and write the scores; -1 where not allowed."""
    item, block, col = wp.tid()
    row = SHIFT_ROWS * block
    if col >= width or row >= height or item >= items:
        return
    some = int(0)
    for i in range(wp.min(SHIFT_ROWS, height - row)):
        some = some + int(allowed[(row + i) * width + col])
    stride = padded_stride(scores)
    last = first[item]
    if some > 0:
        last = first[item + 1]
    total = Rows()
    k = int(first[item])
    while k < last:
        stop = wp.min(k + TOGETHER, last)
        # Two sums of 16 bits in a number.
        even = wp.vec2i()
        odd = wp.vec2i()
        while k < stop:
            cell = cell_at(point, k)
            place = number_at(image, k) + block_index(scores, cell.y + row, cell.x + col, SHIFT_ROWS - 1, 0)
            for i in range(2):
                four = number_at(table, place + 4 * i * stride)
                even[i] = even[i] + (four & 0xFF00FF)
                odd[i] = odd[i] + ((four >> 8) & 0xFF00FF)
            k = k + 1
        for i in range(2):
            total[4 * i] = total[4 * i] + (even[i] & 0xFFFF)
            total[4 * i + 1] = total[4 * i + 1] + (odd[i] & 0xFFFF)
            total[4 * i + 2] = total[4 * i + 2] + ((even[i] >> 16) & 0xFFFF)
            total[4 * i + 3] = total[4 * i + 3] + ((odd[i] >> 16) & 0xFFFF)
    for i in range(SHIFT_ROWS):
        if row + i < height:
            n = (row + i) * width + col
            value = int(-1)
            if allowed[n] > wp.uint8(0):
                value = TOP * (last - first[item]) - unit * total[i]
            score[item * height * width + n] = value


@kernel
def line_maxima(score, best, histogram, all, lines, length, spacing, along, turns, shift):
    """Find the largest score of each line of shifts, and count the lines of each scan by their scores."""
    n = wp.tid()
    if n >= all:
        return
    begin = n % lines * spacing
    mine = n // lines * lines * length + begin
    most = int(-1)
    place = int(0)
    for i in range(length):
        value = number_at(score, mine + i * along)
        if value > most:
            most = value
            place = begin + i * along
    best[2 * n] = most
    best[2 * n + 1] = place
    if most >= 0:
        wp.atomic_add(histogram, n // (lines * turns) * BINS + (most >> shift), 1)


@wp.func
def promising(histogram: wp.array(dtype=wp.int32), scan: wp.int32, most: wp.int32):
    """Return the least score, divided by 2^shift, of the best lines of a scan."""
    bin = int(BINS - 1)
    lines = histogram[scan * BINS + bin]
    while lines < most and bin > 0:
        bin = bin - 1
        lines = lines + histogram[scan * BINS + bin]
    return bin


@kernel
def count_promising(best, histogram, number, items, lines, turns, shift, most):
    """Count the promising lines of each item. One work-item takes an item."""
    item = wp.tid()
    if item >= items:
        return
    least = promising(histogram, item // turns, most) << shift
    some = int(0)
    for line in range(lines):
        if best[2 * (item * lines + line)] >= least:
            some = some + 1
    number[item] = some


@kernel
def pick_blocks(best, histogram, number, block, items, lines, width, turns, level, shift, most):
    """Take most of the promising lines of each scan, evenly spaced: many bounds are equal, most of all the largest."""
    item = wp.tid()
    if item >= items:
        return
    scan = item // turns
    least = promising(histogram, scan, most) << shift
    before = int(0)
    total = int(0)
    for other in range(scan * turns, (scan + 1) * turns):
        if other < item:
            before = before + number[other]
        total = total + number[other]
    taken = wp.int64(wp.min(total, most))
    for i in range(item % turns, most, turns):
        if wp.int64(i) >= taken:
            block[4 * (scan * most + i) + 3] = -1
    for line in range(lines):
        value = best[2 * (item * lines + line)]
        if value >= least:
            place = (wp.int64(before) * taken + wp.int64(total - 1)) // wp.int64(total)
            if place < taken and place * wp.int64(total) // taken == wp.int64(before):
                out = 4 * (scan * most + int(place))
                block[out] = item
                at = best[2 * (item * lines + line) + 1]
                block[out + 1] = (at // width) << level
                block[out + 2] = (at % width) << level
                block[out + 3] = value
            before = before + 1


@kernel
def raise_low(block, slack, low, blocks, most):
    """Raise the least scores of scans to the scores of poses less their slack. One work-item takes a pose."""
    n = wp.tid()
    if n >= blocks:
        return
    if block[4 * n + 3] >= 0:
        wp.atomic_max(low, n // most, block[4 * n + 3] - slack[n // most])


@kernel
def choose_blocks(score, best, low, block, count, all, lines, length, spacing, along, width, turns, level, room):
    """Collect the shifts whose scores are at least low of their scan, in no certain order."""
    k = wp.tid()
    if k >= all:
        return
    item = k // lines
    least = low[item // turns]
    if best[2 * k] < least:
        return
    begin = k % lines * spacing
    mine = item * lines * length + begin
    # A single addition for the whole line.
    some = int(0)
    for i in range(length):
        if number_at(score, mine + i * along) >= least:
            some = some + 1
    n = wp.atomic_add(count, level, some)
    row = begin // width
    col = begin % width
    down = along // width
    right = along % width
    for i in range(length):
        value = number_at(score, mine + i * along)
        if value >= least and n < room:
            block[4 * n] = item
            block[4 * n + 1] = (row + i * down) << level
            block[4 * n + 2] = (col + i * right) << level
            block[4 * n + 3] = value
            n = n + 1


@kernel
def follow_blocks(
    quarters, point, image, first, allowed, block, scores, blocks, height, width, columns, level, spacing, shift,
    across,
):  # fmt: skip
    """Replace blocks of positions by their best allowed quarters of 2^level x 2^level, the first of equal ones."""
    own = work_item(wp.tid())
    n = own // TEAM
    member = own % TEAM
    members = int(1)
    if IN_TEAMS and on_gpu():
        members = TEAM
    if n >= blocks or member >= members:
        return
    score = block[4 * n + 3]
    if score < 0:
        return
    item = block[4 * n]
    row = block[4 * n + 1]
    col = block[4 * n + 2]
    total = divided(
        quarters, point, image, scores, first[item] + member, first[item + 1], members, spacing * (row >> shift),
        spacing * (col >> shift), score, -1, across,
    )  # fmt: skip
    if IN_TEAMS:
        total = left_by_team(total, score)
    if member > 0:
        return
    most = int(-1)
    for i in range(4):
        part_row = row + ((i // 2) << level)
        part_col = col + ((i % 2) << level)
        if part_row < height and part_col < width and total[i] > most:
            if allowed[(part_row >> level) * columns + (part_col >> level)] > wp.uint8(0):
                most = total[i]
                block[4 * n + 1] = part_row
                block[4 * n + 2] = part_col
    block[4 * n + 3] = most


@kernel
def divide_blocks(
    quarters, point, image, first, allowed, block, low, part, count, scores, begin, some, room, workers, run, height,
    width, columns, turns, level, spacing, shift, across,
):  # fmt: skip
    """Divide blocks of positions into quarters, and collect those whose scores may be high enough."""
    worker = work_item(wp.tid())
    blocks = wp.min(count[level + 1] - begin, some)
    members = int(1)
    if IN_TEAMS and on_gpu() and blocks < workers // 4:
        members = TEAM
    member = worker % members
    each = workers // members
    n = run * (worker // members)
    while n < blocks:
        here = 4 * (begin + n)
        item = block[here]
        row = block[here + 1]
        col = block[here + 2]
        least = low[item // turns]
        line = spacing * (row >> shift)
        aside = spacing * (col >> shift)
        score = block[here + 3]
        total = wp.vec4i()
        # Two calls, so that the compiler knows how far points are apart.
        if members > 1:
            if IN_TEAMS:
                own = divided(
                    quarters, point, image, scores, first[item] + member, first[item + 1], TEAM, line, aside, score,
                    least, across,
                )  # fmt: skip
                total = left_by_team(own, score)
        else:
            total = divided(
                quarters, point, image, scores, first[item], first[item + 1], 1, line, aside, score, least, across
            )
        if member == 0:
            for i in range(4):
                part_row = row + ((i // 2) << level)
                part_col = col + ((i % 2) << level)
                if part_row < height and part_col < width and total[i] >= least:
                    if allowed[(part_row >> level) * columns + (part_col >> level)] > wp.uint8(0):
                        m = wp.atomic_add(count, level, 1)
                        if m < room:
                            part[4 * m] = item
                            part[4 * m + 1] = part_row
                            part[4 * m + 2] = part_col
                            part[4 * m + 3] = total[i]
        if n % run == run - 1:
            n = n + run * (each - 1)
        n = n + 1
