"""Many worlds in one table: their cells, obstacles and tables, moving shapes, and poses placed in them.

Worlds of one size are made together. Their rows are interleaved: line i is row i / worlds of world i % worlds.
``place`` holds each world's first cell in tables with a ring of two cells. ``frames`` holds 8 numbers for each world:
x and y of its origin, cosine and sine of its yaw, rows, columns, its first cell, and one that is not used.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface import structs
from gpusense.reference.heading import cos_sin
from gpusense.reference.placement import FARTHEST, place_pose, within_reach
from gpusense.reference.shapes import (
    BOX,
    DISC,
    SIGHTS,
    directions_of,
    nearest_shape,
    particles_of_worlds,
    shape_distance,
    world_begin,
    world_window,
)

# Cells above this one are unknown.
MOST_KNOWN = 127
FRAME_NUMBERS = 8
RING = 2
# Largest number of a shape.
LARGEST_SHAPE = 1e6
# Distance from a world to which its segments and boxes reach [cells].
BEYOND = 16384


def put_cells(flags, cells, place, store, count, worlds, items):
    """Copy the cells of some worlds to their places."""
    for w in range(worlds):
        store[place[w] : place[w] + count] = cells[w * count : (w + 1) * count]


def stops_beam(cell: np.ndarray, threshold: int, unknown: int) -> np.ndarray:
    """Return whether cells stop a beam."""
    return np.where(cell > MOST_KNOWN, bool(unknown), cell >= threshold)


def mark_obstacles(flags, store, place, occupied, bits, rows, cols, worlds, words, margin, threshold, unknown, as_bits):
    """Mark the obstacles of worlds as bytes or as bits, with a margin of obstacles around each world."""
    cells = np.stack([store[place[w] : place[w] + rows * cols].reshape(rows, cols) for w in range(worlds)], axis=1)
    ring = ((margin, margin), (0, 0), (margin, margin))
    marked = np.pad(stops_beam(cells, threshold, unknown), ring, constant_values=True)
    if not as_bits:
        occupied[: marked.size] = marked.reshape(-1)
        return
    packed = np.zeros((rows + 2 * margin, worlds, 4 * words), np.uint8)
    packed[:, :, : -(-marked.shape[2] // 8)] = np.packbits(marked, axis=2, bitorder="little")
    bits[: packed.size // 4] = packed.reshape(-1).view("<i4")


def fill_worlds(flags, squared, density, place, table, rows, cols, worlds, margin, cap, beyond):
    """Fill the likelihood fields of worlds from squared distances, which include a margin."""
    height, width = rows + 2 * margin, cols + 2 * margin
    known = density[np.minimum(squared[: height * worlds * width].reshape(height, worlds, width), cap)]
    ring = RING - margin
    for w in range(worlds):
        padded = np.pad(known[:, w], ring, constant_values=beyond)
        table[place[w] : place[w] + padded.size] = padded.reshape(-1)


def frame_in(frames: np.ndarray, index: int, frame: structs.Frame) -> structs.Frame:
    """Return the frame of a world; all worlds share the scanner's position and the resolution."""
    x, y, cosine, sine = frames[index * FRAME_NUMBERS : index * FRAME_NUMBERS + 4].tolist()
    return frame._replace(origin_x=x, origin_y=y, yaw_cos=cosine, yaw_sin=sine)


def place_in_worlds(
    flags, poses, index, ignore, frames, shapes, pose_cell, pose, pose_low, world, pose_status, frame, particles,
    worlds, wide, wide_ignore, crowd,
):  # fmt: skip
    """Place poses in their worlds; see ``place_pose``. The reference makes no sights: its rays test every shape.

    An index of no world sets the second bit of ``pose_status``, and the pose sees nothing.
    """
    # Indices of 64 bits have 0 in the upper half.
    chosen = index[: wide * particles : wide]
    known = (chosen >= 0) & (chosen < worlds) & ((wide == 1) | (index[wide - 1 : wide * particles : wide] == 0))
    world[1 : 2 * particles : 2, 0] = np.where(known, chosen, 0)
    world[1 : 2 * particles : 2, 1] = ignore[: wide_ignore * particles : wide_ignore] if "SHAPES" in flags else -1
    all_poses = poses.reshape(-1)[: 3 * particles].reshape(-1, 3)
    two_parts = "TWO_PART_POINTS" in flags
    for part in particles_of_worlds(world, particles):
        w = int(world[2 * part[0] + 1, 0])
        rows, cols, first = frames[w * FRAME_NUMBERS + 4 : w * FRAME_NUMBERS + 7].astype(int).tolist()
        cell, placed = np.empty((len(part), 2), np.int32), np.empty((len(part), 4), pose.dtype)
        low = np.empty((len(part) if two_parts else 1, 4), pose.dtype)
        place_pose(
            flags, all_poses[part], cell, placed, low, pose_status, frame_in(frames, w, frame),
            structs.Window(0, 0, rows, cols),
        )  # fmt: skip
        pose_cell[part], pose[part] = cell, placed
        if two_parts:
            pose_low[part] = low
        world[2 * part] = first, rows << 16 | cols
    if not known.all():
        pose_status[0] |= 2
        pose_cell[:particles][~known] = -int(FARTHEST)


def find_sights(flags, shapes, world, pose_cell, pose, sights, particles, crowd):
    """Find the sights of particles. NumPy's rays test every shape, and need none."""
    words = 2 * crowd.pairs
    found = sights[2 * crowd.begin : 2 * crowd.begin + particles * SIGHTS * words].reshape(particles, SIGHTS, words)
    with np.errstate(all="ignore"):
        for i in range(crowd.discs + crowd.boxes + crowd.segments):
            ranges = directions_of(shapes, world[: 2 * particles], crowd, i, pose_cell[:particles], pose[:particles])
            for n, (begin, end) in enumerate(zip(*ranges, strict=True)):
                found[n, np.arange(begin, end) % SIGHTS, i // 32] |= np.array(1 << i % 32, np.uint32).view(np.int32)


def meet_shapes(flags, shapes, world, pose_cell, pose, ray, turns, ranges, particles, rays, limit, crowd):
    """Find the distances of the nearest shapes along the rays of particles, ``limit`` where none is nearer.

    NumPy's rays test every shape, and need no ``turns``.
    """
    block = max((1 << 15) // max(rays, 1), 1)
    for first in range(0, particles, block):
        part = slice(first, min(first + block, particles))
        of_rays = np.repeat(world[2 * part.start : 2 * part.stop].reshape(-1, 4), rays, axis=0).reshape(-1, 2)
        lanes = (np.repeat(pose_cell[part], rays, axis=0), np.repeat(pose[part], rays, axis=0))
        beams = np.tile(ray[:rays], (part.stop - first, 1))
        t = np.full(len(beams), pose.dtype.type(limit))
        ranges[first * rays : part.stop * rays] = nearest_shape(shapes, of_rays, crowd, *lanes, beams, t)[0]


def point_in(points: np.ndarray, here: structs.Frame) -> np.ndarray:
    """Return (M, 2) points of the world in cells of a frame."""
    u, v = points[:, 0] - here.origin_x, points[:, 1] - here.origin_y
    if here.yaw_sin != 0:
        u, v = here.yaw_cos * u + here.yaw_sin * v, here.yaw_cos * v - here.yaw_sin * u
    return np.stack([within_reach(u / here.resolution), within_reach(v / here.resolution)], axis=1)


def part_near(low: np.ndarray, high: np.ndarray, at: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the parts of intervals within reach of numbers, or an interval where its part is empty."""
    begin, end = np.maximum(low, at - reach), np.minimum(high, at + reach)
    return np.where(begin < end, begin, low), np.where(begin < end, end, high)


def place_shapes(flags, raw, frames, shapes, frame, count, numbers, begin, stride, worlds):
    """Place moving shapes of one kind, with 3 (discs), 5 (boxes) or 4 numbers (segments), in the cells of their worlds.

    A shape with a number that is not finite or beyond LARGEST_SHAPE, or with a negative size, is none. Segments and
    boxes lose what is farther than BEYOND from their world: float32 does not hold where they pass if their ends are
    very far.
    """
    every = raw.reshape(-1)[: worlds * count * numbers].reshape(worlds, count, numbers).astype(np.float64)
    each = BOX if numbers == 5 else DISC
    out = shapes[: worlds * stride].reshape(worlds, stride)[:, begin : begin + count * each]
    for w in range(worlds):
        here, rows = frame_in(frames, w, frame), every[w]
        placed = np.zeros((count, each))
        none = ~(np.abs(rows) <= LARGEST_SHAPE).all(axis=1)
        rows = np.where(none[:, None], 0.0, rows)
        sizes = {3: rows[:, 2:3], 5: rows[:, 3:5]}.get(numbers)
        centre = point_in(rows[:, :2], here)
        reach = frames[w * FRAME_NUMBERS + 4] + frames[w * FRAME_NUMBERS + 5] + BEYOND
        if sizes is None:
            other = point_in(rows[:, 2:4], here)
            way = other - centre
            whole = np.sqrt(way[:, 0] * way[:, 0] + way[:, 1] * way[:, 1])[:, None]
            with np.errstate(invalid="ignore"):
                at = -(way[:, :1] * centre[:, :1] + way[:, 1:] * centre[:, 1:]) / whole
                first, last = part_near(np.zeros_like(whole), whole, at, reach)
                placed[:, 2:4] = np.where(last < whole, centre + way * (last / whole), other)
                centre = np.where(first > 0, centre + way * (first / whole), centre)
        elif numbers == 3:
            placed[:, 2:3] = sizes / here.resolution
        else:
            cosine, sine = cos_sin(np.where(none, 0.0, rows[:, 2]))
            if here.yaw_sin != 0:
                cosine, sine = cosine * here.yaw_cos + sine * here.yaw_sin, sine * here.yaw_cos - cosine * here.yaw_sin
            (u, v), (x, y) = (sizes / here.resolution / 2).T, centre.T
            parts = part_near(-u, u, -(cosine * x + sine * y), reach), part_near(-v, v, sine * x - cosine * y, reach)
            (by_u, half_length), (by_v, half_width) = (((low + high) / 2, (high - low) / 2) for low, high in parts)
            centre = np.stack([x + (cosine * by_u - sine * by_v), y + (sine * by_u + cosine * by_v)], axis=1)
            # The radius of a circle around the box, with a margin for rounding.
            placed[:, 6] = np.sqrt(half_length * half_length + half_width * half_width) * 1.00001 + 0.001
            placed[:, 2], placed[:, 3], placed[:, 4], placed[:, 5] = cosine, sine, half_length, half_width
        placed[:, :2] = centre
        if sizes is not None:
            none |= (sizes < 0).any(axis=1)
        placed[none] = np.nan
        out[w] = placed.reshape(-1)


def find_collisions(flags, store, world, shapes, pose_cell, pose, hit, particles, radius, crowd, threshold, unknown):
    """Tell which discs about poses, with a radius in cells, meet an obstacle or a shape."""
    hit[:particles] = 0
    if "SHAPES" in flags:
        own = world[: 2 * particles]
        hit[:particles] = shape_distance(shapes, own, crowd, pose_cell[:particles], pose[:particles, :2]) <= radius
    reach = int(radius) + 1
    for n in range(particles):
        window, begin = world_window(world, n), world_begin(world, n, 1)
        cells = store[begin : begin + window.rows * window.cols].reshape(window.rows, window.cols)
        col, row = pose_cell[n].tolist()
        rows = np.arange(max(row - reach, 0), min(row + reach, window.rows - 1) + 1)
        cols = np.arange(max(col - reach, 0), min(col + reach, window.cols - 1) + 1)
        if not (len(rows) and len(cols)):
            continue
        offsets = []
        for at, first, fraction in ((rows, row, pose[n, 1]), (cols, col, pose[n, 0])):
            before = (at - first).astype(pose.dtype) - fraction
            offsets.append(np.maximum(np.maximum(before, -(before + 1)), 0))
        near = offsets[0][:, None] ** 2 + offsets[1] ** 2 <= radius * radius
        stops = stops_beam(cells[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1], threshold, unknown)
        hit[n] |= (near & stops).any()
