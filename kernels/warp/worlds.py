"""Many worlds in one table: their cells, obstacles and tables, moving shapes, and poses placed in them.

Worlds of one size are made together. Their rows are interleaved: line i is row i / worlds of world i % worlds. place
has the first cell of each in tables with a ring of two cells. frames has 8 numbers for each world: x and y of its
origin, cosine and sine of its yaw, rows, columns, its first cell, and one that is not used.
"""

import math

import warp as wp

from .flags import SEES, SHAPES
from .heading import cos_sin
from .placement import FARTHEST, ZERO, place_pose, within_reach
from .prelude import kernel, work_item
from .shapes import BOX, DISC, SIGHTS, shape_distance, sight_at, sights_of, world_window
from .types import Frame, Window, real, vec2

# Cells above this one are unknown.
MOST_KNOWN = wp.constant(127)
FRAME_NUMBERS = wp.constant(8)
RING = wp.constant(2)
# Largest number of a shape.
LARGEST_SHAPE = wp.constant(wp.float64(1e6))
# Distance from a world to which its segments and boxes reach [cells].
BEYOND = wp.constant(wp.float64(16384.0))


@kernel
def put_cells(cells, place, store, count, worlds, items):
    """Copy the cells of some worlds to their places. One work-item takes every items-th cell."""
    w, first = wp.tid()
    if first >= items or w >= worlds:
        return
    for i in range(first, count, items):
        store[place[w] + i] = cells[w * count + i]


@wp.func
def stops_beam(cell: wp.int32, threshold: wp.int32, unknown: wp.int32):
    """Return whether a cell stops a beam."""
    return wp.where(cell > MOST_KNOWN, unknown, wp.where(cell >= threshold, 1, 0))


@kernel
def mark_obstacles(store, place, occupied, bits, rows, cols, worlds, words, margin, threshold, unknown, as_bits):
    """Mark the obstacles of worlds as bytes or as bits, with a margin of obstacles around each world."""
    item = work_item(wp.tid())
    line = item // words
    word = item % words
    width = cols + 2 * margin
    if line >= (rows + 2 * margin) * worlds:
        return
    row = line // worlds - margin
    w = line % worlds
    marked = wp.uint32(0)
    for i in range(wp.min(32, width - 32 * word)):
        col = 32 * word + i - margin
        stops = int(1)
        if col >= 0 and col < cols and row >= 0 and row < rows:
            stops = stops_beam(int(store[place[w] + row * cols + col]), threshold, unknown)
        if as_bits == 0:
            occupied[line * width + 32 * word + i] = wp.uint8(stops)
        marked = marked | (wp.uint32(stops) << wp.uint32(i))
    if as_bits != 0:
        bits[line * words + word] = wp.int32(marked)


NUMBER_ZERO, NUMBER_ONE = real(0.0), real(1.0)
NEVER, NONE, TWO = real(math.inf), real(math.nan), wp.float64(2.0)


@kernel
def fill_worlds(squared, density, place, table, rows, cols, worlds, margin, cap, beyond):
    """Fill the likelihood fields of worlds from squared distances, which include a margin."""
    line, col = wp.tid()
    width = cols + 2 * RING
    if col >= width or line >= (rows + 2 * RING) * worlds:
        return
    row = line // worlds
    w = line % worlds
    from_row = row - RING + margin
    from_col = col - RING + margin
    value = beyond
    if from_row >= 0 and from_row < rows + 2 * margin and from_col >= 0 and from_col < cols + 2 * margin:
        at = (from_row * worlds + w) * (cols + 2 * margin) + from_col
        value = density[wp.min(squared[at], cap)]
    table[place[w] + row * width + col] = value


@wp.func
def frame_in(frames: wp.array(dtype=wp.float64), index: wp.int32, frame: Frame):
    """Return the frame of a world; all worlds share the scanner's position and the resolution."""
    first = index * FRAME_NUMBERS
    moved = Frame()
    moved.origin_x = frames[first]
    moved.origin_y = frames[first + 1]
    moved.resolution = frame.resolution
    moved.mount_x = frame.mount_x
    moved.mount_y = frame.mount_y
    moved.yaw_cos = frames[first + 2]
    moved.yaw_sin = frames[first + 3]
    return moved


@kernel
def place_in_worlds(
    poses, index, ignore, frames, shapes, pose_cell, pose, pose_low, world, pose_status, frame, particles, worlds,
    wide, wide_ignore, crowd,
):  # fmt: skip
    """Place poses in their worlds; see place_pose."""
    particle = work_item(wp.tid())
    if particle >= particles:
        return
    # Indices of 64 bits have 0 in the upper half.
    chosen = index[wide * particle]
    known = chosen >= 0 and chosen < worlds
    if wide == 2:
        known = known and index[2 * particle + 1] == 0
    w = wp.where(known, chosen, 0)
    first = w * FRAME_NUMBERS
    window = Window()
    window.rows = int(frames[first + 4])
    window.cols = int(frames[first + 5])
    place_pose(particle, poses, pose_cell, pose, pose_low, pose_status, frame_in(frames, w, frame), window)
    if not known:
        wp.atomic_max(pose_status, 0, 2)
        pose_cell[particle] = wp.vec2i(-int(FARTHEST), -int(FARTHEST))
    world[2 * particle] = wp.vec2i(int(frames[first + 6]), (window.rows << 16) | window.cols)
    if SHAPES:
        world[2 * particle + 1] = wp.vec2i(w, ignore[wide_ignore * particle])
        if SEES:
            for k in range(SIGHTS * crowd.pairs):
                world[crowd.begin + k * particles + particle] = wp.vec2i(0, 0)
    else:
        world[2 * particle + 1] = wp.vec2i(w, -1)


@kernel
def find_sights(shapes, world, pose_cell, pose, sights, particles, crowd):
    """Find the sights of particles. One work-item takes a particle and shape."""
    item = work_item(wp.tid())
    count = crowd.discs + crowd.boxes + crowd.segments
    n = item // count
    i = item % count
    if n >= particles:
        return
    directions = sights_of(shapes, world, crowd, n, i, pose_cell[n], pose[n])
    for k in range(directions.x, directions.y):
        # Each bit is added to a word once.
        wp.atomic_add(sights, 2 * sight_at(crowd, n, k) + (i >> 5), int(wp.uint32(1) << wp.uint32(i & 31)))


@wp.func
def point_in(x: wp.float64, y: wp.float64, here: Frame):
    """Return a point of the world in cells of a frame."""
    u = x - here.origin_x
    v = y - here.origin_y
    if here.yaw_sin != ZERO:
        before = u
        u = here.yaw_cos * u + here.yaw_sin * v
        v = here.yaw_cos * v - here.yaw_sin * before
    return wp.vec2d(within_reach(u / here.resolution), within_reach(v / here.resolution))


@wp.func
def part_near(low: wp.float64, high: wp.float64, at: wp.float64, reach: wp.float64):
    """Return the part of an interval within reach of a number, or the interval where that part is empty."""
    begin = wp.max(low, at - reach)
    end = wp.min(high, at + reach)
    return wp.where(begin < end, wp.vec2d(begin, end), wp.vec2d(low, high))


@kernel
def place_shapes(raw, frames, shapes, frame, count, numbers, begin, stride, worlds):
    """Place moving shapes of one kind."""
    w, i = wp.tid()
    if i >= count or w >= worlds:
        return
    at = (w * count + i) * numbers
    to = w * stride + begin + i * wp.where(numbers == 5, BOX, DISC)
    here = frame_in(frames, w, frame)
    none = bool(False)
    for k in range(numbers):
        if not (wp.abs(wp.float64(raw[at + k])) <= LARGEST_SHAPE):
            none = bool(True)
    length = wp.float64(raw[at + wp.where(numbers == 3, 2, 3)])
    if numbers != 4 and length < ZERO:
        none = bool(True)
    if numbers == 5:
        if wp.float64(raw[at + 4]) < ZERO:
            none = bool(True)
    if none:
        for k in range(wp.where(numbers == 5, BOX, DISC)):
            shapes[to + k] = NONE
        return
    centre = point_in(wp.float64(raw[at]), wp.float64(raw[at + 1]), here)
    reach = frames[w * FRAME_NUMBERS + 4] + frames[w * FRAME_NUMBERS + 5] + BEYOND
    if numbers == 3:
        shapes[to + 2] = real(length / here.resolution)
        shapes[to + 3] = NUMBER_ZERO
    elif numbers == 4:
        other = point_in(wp.float64(raw[at + 2]), length, here)
        x = other.x - centre.x
        y = other.y - centre.y
        whole = wp.sqrt(x * x + y * y)
        part = part_near(ZERO, whole, -(x * centre.x + y * centre.y) / whole, reach)
        if part.y < whole:
            other = wp.vec2d(centre.x + x * (part.y / whole), centre.y + y * (part.y / whole))
        if part.x > ZERO:
            centre = wp.vec2d(centre.x + x * (part.x / whole), centre.y + y * (part.x / whole))
        shapes[to + 2] = real(other.x)
        shapes[to + 3] = real(other.y)
    else:
        turned = cos_sin(wp.float64(raw[at + 2]))
        cosine = turned.x
        sine = turned.y
        if here.yaw_sin != ZERO:
            cosine = turned.x * here.yaw_cos + turned.y * here.yaw_sin
            sine = turned.y * here.yaw_cos - turned.x * here.yaw_sin
        u = length / here.resolution / TWO
        v = wp.float64(raw[at + 4]) / here.resolution / TWO
        along = part_near(-u, u, -(cosine * centre.x + sine * centre.y), reach)
        aside = part_near(-v, v, sine * centre.x - cosine * centre.y, reach)
        by_u = (along.x + along.y) / TWO
        by_v = (aside.x + aside.y) / TWO
        middle_x = centre.x + (cosine * by_u - sine * by_v)
        middle_y = centre.y + (sine * by_u + cosine * by_v)
        centre = wp.vec2d(middle_x, middle_y)
        half_length = (along.y - along.x) / TWO
        half_width = (aside.y - aside.x) / TWO
        shapes[to + 2] = real(cosine)
        shapes[to + 3] = real(sine)
        shapes[to + 4] = real(half_length)
        shapes[to + 5] = real(half_width)
        # The radius of a circle around the box, with a margin for rounding.
        around = wp.sqrt(half_length * half_length + half_width * half_width)
        shapes[to + 6] = real(around * wp.float64(1.00001) + wp.float64(0.001))
        shapes[to + 7] = NUMBER_ZERO
    shapes[to] = real(centre.x)
    shapes[to + 1] = real(centre.y)


@kernel
def find_collisions(store, world, shapes, pose_cell, pose, hit, particles, radius, crowd, threshold, unknown):
    """Tell which discs about poses, with a radius in cells, meet an obstacle or a shape."""
    n = wp.tid()
    if n >= particles:
        return
    window = world_window(world, n)
    cell = pose_cell[n]
    point = vec2(pose[n].x, pose[n].y)
    met = int(0)
    if SHAPES:
        if shape_distance(shapes, world, crowd, n, cell, point) <= radius:
            met = 1
    reach = int(radius) + 1
    for row in range(wp.max(cell.y - reach, 0), wp.min(cell.y + reach, window.rows - 1) + 1):
        below = real(row - cell.y) - point.y
        above = -(below + NUMBER_ONE)
        off_y = wp.where(below > NUMBER_ZERO, below, wp.where(above > NUMBER_ZERO, above, NUMBER_ZERO))
        for col in range(wp.max(cell.x - reach, 0), wp.min(cell.x + reach, window.cols - 1) + 1):
            left = real(col - cell.x) - point.x
            right = -(left + NUMBER_ONE)
            off_x = wp.where(left > NUMBER_ZERO, left, wp.where(right > NUMBER_ZERO, right, NUMBER_ZERO))
            if off_x * off_x + off_y * off_y <= radius * radius:
                if stops_beam(int(store[world[2 * n].x + row * window.cols + col]), threshold, unknown) != 0:
                    met = 1
    hit[n] = wp.uint8(met)
