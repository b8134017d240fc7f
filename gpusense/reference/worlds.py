"""Many worlds in one table: their cells, obstacles and tables, poses placed in them, and collisions.

Worlds of one size are made together. Their rows are interleaved: line i is row i / worlds of world i % worlds.
``place`` holds each world's first cell in tables with a ring of two cells.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface import structs
from gpusense.reference.placement import FARTHEST, FRAME_NUMBERS, frame_in, place_pose
from gpusense.reference.shapes import particles_of_worlds, shape_distance, world_begin, world_window

# Cells above this one are unknown.
MOST_KNOWN = 127
RING = 2


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
