"""Empty rectangles: for each cell and sector of directions, width and height of a rectangle of free cells."""

import warp as wp

from gpusense.interface.constants import RECTANGLE_REACH

from .bits import cells_left, cells_right, occupied_at
from .prelude import behind, kernel, reader, writer

LONGEST = 255
# The entry of an occupied cell; ring cells have 0.
OCCUPIED = 1
# Capacity of the stack of columns that may bound a rectangle.
STACK = 256
behind_of, run_at = behind(wp.uint16), reader(wp.uint8)
put = writer(wp.uint16)


# Write up to four runs.
@wp.func_native("""
if (count == 4 && ((size_t)(values.data + i) & 3) == 0) *(int *)(values.data + i) = runs;
else for (int k = 0; k < count; ++k) values.data[i + k] = (unsigned char)(runs >> 8 * k);
""")
def put_runs(values: wp.array(dtype=wp.uint8), i: wp.int32, count: wp.int32, runs: wp.int32): ...


# Write four rows, the last first, or in this order where the direction is below 0.
@wp.func_native("""
if (dy < 0) four = four << 48 | (four << 16 & 0xffff00000000) | (four >> 16 & 0xffff0000) | four >> 48;
*reinterpret_cast<unsigned long long *>(values.data + i) = four;
""")
def put_four(values: wp.array(dtype=wp.uint16), i: wp.int32, four: wp.uint64, dy: wp.int32): ...


@wp.func
def padded(row: wp.int32, col: wp.int32, cols: wp.int32):
    """Return the index of a cell in a padded plane."""
    return (row + 1) * (cols + 2) + col + 1


@wp.func
def padded_in_groups(row: wp.int32, col: wp.int32, cols: wp.int32, group: wp.int32):
    """Return the index of a cell in a padded plane of groups of rows, a power of two of them."""
    in_group = (row + 1) & (group - 1)
    return (row + 1 - in_group) * (cols + 2) + (col + 1) * group + in_group


@wp.func
def reach_begin(way: wp.int32, low: wp.int32):
    """Return the first cell along an axis whose rectangle can contain the cell low or one beyond it."""
    return wp.where(way > 0, wp.max(low - RECTANGLE_REACH, 0), low)


@wp.func
def reach_end(way: wp.int32, high: wp.int32, size: wp.int32):
    """Return one beyond the last cell whose rectangle can contain a cell before high."""
    return wp.where(way > 0, high, wp.min(high + RECTANGLE_REACH, size))


@wp.func
def slope(sectors: wp.int32, sector: wp.int32):
    """Return height and width in the proportion of the ray in the middle of a sector."""
    if sectors == 1:
        return wp.vec2i(1, 1)
    if sectors == 2:
        if sector == 0:
            return wp.vec2i(5, 12)
        return wp.vec2i(12, 5)
    if sector == 0:
        return wp.vec2i(1, 5)
    if sector == 1:
        return wp.vec2i(2, 3)
    if sector == 2:
        return wp.vec2i(3, 2)
    return wp.vec2i(5, 1)


@kernel
def free_columns(occupied, runs, band, cols, begin, end):
    """Count the free cells along columns of the band, to larger or smaller rows."""
    direction, strip = wp.tid()
    first = begin + 64 * strip
    until = wp.min(first + 64, end)
    out = direction * band * cols
    for i in range(band):
        row = wp.where(direction == 1, i, band - 1 - i)
        before = wp.where(direction == 1, row - 1, row + 1)
        for col in range(first, until):
            run = int(0)
            if i > 0:
                run = int(runs[out + before * cols + col])
            free = wp.where(occupied[row * cols + col] != wp.uint8(0), 0, wp.min(run + 1, LONGEST))
            runs[out + row * cols + col] = wp.uint8(free)


@kernel
def rectangles_rows(
    runs, place, stack, rectangles, rows, cols, sectors, first, band, top, left, bottom, right, worlds, lines, group
):  # fmt: skip
    """Find the rectangles along rows, from the far end of a row to its begin."""
    way, item = wp.tid()
    quadrant = way & 3
    w = way >> 2
    dx = wp.where((quadrant & 1) != 0, -1, 1)
    dy = wp.where((quadrant & 2) != 0, -1, 1)
    row = reach_begin(dy, top) + item
    if row >= reach_end(dy, bottom, rows) or w >= worlds:
        return
    planes = behind_of(rectangles, wp.int64(place[w]) * wp.int64(4 * sectors))
    run = ((wp.where(dy > 0, 0, band) + row - first) * worlds + w) * cols
    waiting = (item * 4 * worlds + way) * STACK
    begin = reach_begin(dx, left)
    end = reach_end(dx, right, cols)
    scanned = wp.where(dx > 0, wp.min(end + RECTANGLE_REACH, cols) - begin, end - wp.max(begin - RECTANGLE_REACH, 0))
    for sector in range(sectors):
        middle = slope(sectors, sector)
        out = (quadrant * sectors + sector) * lines * (cols + 2)
        oldest = int(0)
        newest = int(0)
        width = int(0)
        for i in range(scanned):
            col = wp.where(dx > 0, begin + scanned - 1 - i, end - scanned + i)
            here = int(runs[run + col])
            while newest > oldest and (stack[waiting + ((newest - 1) & (STACK - 1))] >> 16) >= here:
                newest -= 1
            stack[waiting + (newest & (STACK - 1))] = (here << 16) | (col & 65535)
            newest += 1
            height = int(LONGEST)
            width = wp.min(width + 1, LONGEST)
            fits = bool(False)
            while width > 0 and not fits:
                while ((dx * (stack[waiting + (oldest & (STACK - 1))] - col)) & 65535) >= width:
                    oldest += 1
                height = stack[waiting + (oldest & (STACK - 1))] >> 16
                if height * middle[1] >= width * middle[0]:
                    fits = True
                else:
                    height = int(LONGEST)
                    width -= 1
            if col >= begin and col < end:
                other = col + dx * width
                lower = int(0)
                if width < LONGEST and other >= 0 and other < cols:
                    lower = wp.min(height, int(runs[run + other]))
                sides = wp.where(width > 0, width + 256 * height, OCCUPIED)
                if lower * middle[1] > width * middle[0]:
                    sides = width + 1 + 256 * lower
                planes[out + padded_in_groups(row, col, cols, group)] = wp.uint16(sides)


@kernel
def free_rows(bits, runs, band, cols, words, begin, end):
    """Count the free cells along rows, to the right and to the left."""
    row, item = wp.tid()
    start = begin + 4 * item
    if row >= band or start >= end:
        return
    last = wp.min(start + 4, end) - 1
    line = row * words
    right = wp.min(cells_right(bits, line, words, last, LONGEST), cols - last)
    left = wp.min(cells_left(bits, line, start, LONGEST), start + 1)
    ahead = int(0)
    behind = int(0)
    for i in range(last - start + 1):
        if i > 0:
            right = wp.where(occupied_at(bits, line, last - i), 0, right + 1)
            left = wp.where(occupied_at(bits, line, start + i), 0, left + 1)
        ahead = (ahead << 8) | wp.min(right, LONGEST)
        behind = behind | (wp.min(left, LONGEST) << (8 * i))
    put_runs(runs, row * cols + start, last - start + 1, ahead)
    put_runs(runs, (band + row) * cols + start, last - start + 1, behind)


@kernel
def rectangles_scan(
    runs, place, rectangles, rows, cols, sectors, first, band, top, left, bottom, right, worlds, lines, group, tall
):  # fmt: skip
    """Find the rectangles along columns: the higher a rectangle, the narrower."""
    way, tile_item, col_item = wp.tid()
    quadrant = way & 3
    w = way >> 2
    dx = wp.where((quadrant & 1) != 0, -1, 1)
    dy = wp.where((quadrant & 2) != 0, -1, 1)
    sector = tile_item % sectors
    tile = tile_item // sectors
    col = reach_begin(dx, left) + col_item
    # Rows of the padded plane.
    since = reach_begin(dy, top) + 1
    until = reach_end(dy, bottom, rows) + 1
    tiles = wp.max((until - (since & ~3)) // tall, 1)
    corner = (since & ~3) + tall * tile
    begin = wp.max(corner, since)
    end = wp.where(tile == tiles - 1, until, corner + tall)
    if col >= reach_end(dx, right, cols) or w >= worlds or tile >= tiles:
        return
    planes = behind_of(rectangles, wp.int64(place[w]) * wp.int64(4 * sectors))
    out = (quadrant * sectors + sector) * lines * (cols + 2)
    middle = slope(sectors, sector)
    step = dy * worlds * cols
    # x * inverse >> 16 is x * middle[0] / middle[1] for x up to LONGEST.
    inverse = middle[0] * (65536 // middle[1] + 1)
    # Begin at the row before the tile, whose rectangle may have a row less: the next one may have a row more.
    before = wp.where(dy > 0, end, begin - 1)
    room = wp.min(wp.where(dy > 0, rows + 1 - before, before), LONGEST - 1)
    run = (((quadrant & 1) * band + before - 1 - first) * worlds + w) * cols + col
    height = int(0)
    width = int(LONGEST)
    narrower = int(0)
    bound = int(0)
    wider = int(LONGEST)
    nearer = int(0)
    fits = bool(True)
    while fits:
        narrower = int(0)
        if height < room:
            narrower = wp.min(width, int(run_at(runs, run + height * step)))
        fits = narrower * middle[0] >= (height + 1) * middle[1]
        if fits:
            if narrower < width:
                wider = width
                nearer = bound
                bound = height
            width = narrower
            height += 1
    # Rows of a write, less one: a write of four takes no longer than a write of one.
    others = wp.where(group > 1, 3, 0)
    edge = wp.where(dy > 0, 0, others)
    four = wp.uint64(0)
    run -= step
    following = int(run_at(runs, run))
    row = wp.where(dy > 0, end - 1, begin)
    remaining = end - begin
    while remaining > 0:
        here = following
        remaining -= 1
        if remaining > 0:
            following = int(run_at(runs, run - step))
        least = wp.min(here, width)
        room = wp.min(room + 1, LONGEST)
        higher = height < room and least * middle[0] >= (height + 1) * middle[1]
        bound = wp.where(here <= width, 0, bound + 1)
        nearer = wp.where(here <= wider, 0, nearer + 1)
        wider = wp.where(here <= width, LONGEST, wp.min(here, wider))
        narrower = wp.where(higher, wp.min(here, narrower), least)
        height = wp.where(higher, height + 1, wp.min(height, (here * inverse) >> 16))
        narrower = wp.where(height == room, 0, narrower)
        width = wp.where(height > 0, least, LONGEST)
        if height > 0 and bound >= height:
            width = wider
            bound = nearer
            wider = int(-1)
            if width < 0 or bound >= height:
                width = int(LONGEST)
                bound = int(0)
                wider = int(LONGEST)
                for j in range(height):
                    other = int(run_at(runs, run + j * step))
                    if other < width:
                        wider = width
                        nearer = bound
                        width = other
                        bound = j
        sides = wp.where(height > 0, width + 256 * height, OCCUPIED)
        if narrower * middle[0] > height * middle[1]:
            sides = narrower + 256 * (height + 1)
        four = (four << wp.uint64(16)) | wp.uint64(wp.uint32(sides))
        if (row & others) == edge or remaining == 0:
            lowest = row & ~others
            highest = lowest + others
            if others > 0 and lowest >= begin and highest < end:
                put_four(planes, out + padded_in_groups(lowest - 1, col, cols, group), four, dy)
            else:
                k = int(row)
                oldest = wp.where(dy > 0, wp.min(highest, end - 1), wp.max(lowest, begin))
                while (oldest - k) * dy >= 0:
                    put(planes, out + padded_in_groups(k - 1, col, cols, group), wp.uint16(four & wp.uint64(65535)))
                    four = four >> wp.uint64(16)
                    k += dy
        row -= dy
        run -= step
