"""Many worlds in one table: their cells, obstacles and tables, poses placed in them, and collisions."""

import warp as wp

from .flags import SEES, SHAPES
from .placement import FARTHEST, FRAME_NUMBERS, frame_in, place_pose
from .prelude import kernel, work_item
from .shapes import SIGHTS, shape_distance, world_window
from .types import Window, real, vec2

# Cells above this one are unknown.
MOST_KNOWN = wp.constant(127)
RING = wp.constant(2)


# Return the number of fours of cells if they are aligned, else 0.
@wp.func_native("return (size_t)(cells.data + first) & 3 ? 0 : count / 4;")
def fours_of(cells: wp.array(dtype=wp.uint8), first: wp.int32, count: wp.int32) -> wp.int32: ...


# Copy four cells.
@wp.func_native("*(unsigned int *)(store.data + to) = *(const unsigned int *)(cells.data + first);")
def put_four(store: wp.array(dtype=wp.uint8), to: wp.int32, cells: wp.array(dtype=wp.uint8), first: wp.int32): ...


@kernel
def put_cells(cells, place, store, count, worlds, items):
    """Copy the cells of some worlds to their places. One work-item takes every items-th cell."""
    w, first = wp.tid()
    if first >= items or w >= worlds:
        return
    fours = fours_of(cells, w * count, count)
    for i in range(first, fours, items):
        put_four(store, place[w] + 4 * i, cells, w * count + 4 * i)
    for i in range(4 * fours + first, count, items):
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


ZERO, ONE = real(0.0), real(1.0)


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
        above = -(below + ONE)
        off_y = wp.where(below > ZERO, below, wp.where(above > ZERO, above, ZERO))
        for col in range(wp.max(cell.x - reach, 0), wp.min(cell.x + reach, window.cols - 1) + 1):
            left = real(col - cell.x) - point.x
            right = -(left + ONE)
            off_x = wp.where(left > ZERO, left, wp.where(right > ZERO, right, ZERO))
            if off_x * off_x + off_y * off_y <= radius * radius:
                if stops_beam(int(store[world[2 * n].x + row * window.cols + col]), threshold, unknown) != 0:
                    met = 1
    hit[n] = wp.uint8(met)
