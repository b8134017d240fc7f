"""Moving shapes of worlds: their places in the cells of grids, directions from poses, and the nearest along rays."""

from __future__ import annotations

import numpy as np

from gpusense.interface import structs
from gpusense.reference.heading import cos_sin
from gpusense.reference.placement import FRAME_NUMBERS, frame_in, within_reach
from gpusense.reference.shapes import BOX, DIRECTIONS, DISC, SIGHTS, directions_of, nearest_shape

# Largest number of a shape.
LARGEST_SHAPE = 1e6
# Distance from a world to which its segments and boxes reach [cells].
BEYOND = 16384


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

    ``ray`` lists the rays in the order at the end of ``turns``. NumPy's rays test every shape.
    """
    block, order = max((1 << 15) // max(rays, 1), 1), turns[DIRECTIONS + 1 : DIRECTIONS + 1 + rays]
    for first in range(0, particles, block):
        part = slice(first, min(first + block, particles))
        of_rays = np.repeat(world[2 * part.start : 2 * part.stop].reshape(-1, 4), rays, axis=0).reshape(-1, 2)
        lanes = (np.repeat(pose_cell[part], rays, axis=0), np.repeat(pose[part], rays, axis=0))
        beams = np.tile(ray[:rays], (part.stop - first, 1))
        t = np.full(len(beams), pose.dtype.type(limit))
        nearest = nearest_shape(shapes, of_rays, crowd, *lanes, beams, t)[0].reshape(-1, rays)
        ranges[first * rays : part.stop * rays].reshape(-1, rays)[:, order] = nearest


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
