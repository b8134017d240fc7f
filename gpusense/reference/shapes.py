"""Moving shapes of a world: discs, boxes and segments, in cells of its grid.

A disc has 4 numbers: centre and radius, and one that is not used. A box has 8: centre, cosine and sine of its
direction, half its length and width, radius around it, and one not used. A segment has 4: its ends. A shape whose
numbers are NaN is met by no ray. WORLDS: world has two pairs of numbers for each particle: the first cell of its world
among all worlds and the world's size, rows times 2^16 plus columns; the world's index and the index of the shape that
it does not see.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gpusense.interface import structs
from gpusense.reference.ray import TINY, ray_direction

DISC, BOX, SEGMENT = 4, 8, 4
# Ranges of directions of a particle's sights, and of a table of beams.
SIGHTS, DIRECTIONS = 64, 4096
# Widening of a shape's range, in quarters of a turn.
APART = 1.25e-4


def world_window(world: np.ndarray, n: int) -> structs.Window:
    """Return the part of the grid that a particle's world fills."""
    size = int(world[2 * n, 1])
    return structs.Window(0, 0, size >> 16, size & 0xFFFF)


def world_begin(world: np.ndarray, n: int, each: int) -> int:
    """Return the first entry of a particle's world in a table with ``each`` entries for a cell."""
    return int(world[2 * n, 0]) * each


def particles_of_worlds(world: np.ndarray, particles: int) -> Iterator[np.ndarray]:
    """Yield the particles of each world."""
    index = world[1 : 2 * particles : 2, 0]
    order = np.argsort(index, kind="stable")
    yield from np.split(order, np.flatnonzero(np.diff(index[order])) + 1)


def turned(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return directions as numbers from 0 to 4, which grow with the angle."""
    part = y / (np.abs(x) + np.abs(y))
    return np.where(x >= 0, 1 + part, 3 - part)


def directions_of(
    shapes: np.ndarray, world: np.ndarray, crowd: structs.Crowd, i: int, cell: np.ndarray, pose: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the first range of directions in which each particle sees a shape and the one after the last."""
    real, (index, ignored) = pose.dtype.type, world[1::2].T
    boxes, segments = max(i - crowd.discs, 0), max(i - crowd.discs - crowd.boxes, 0)
    one = index.astype(np.int64) * crowd.stride + DISC * (i - boxes) + BOX * (boxes - segments) + SEGMENT * segments
    x, y = ((shapes[one + k] - cell[:, k].astype(real)) - pose[:, k] for k in range(2))
    if i < crowd.discs + crowd.boxes:
        radius, square = shapes[one + (2 if i < crowd.discs else 6)], x * x + y * y
        away = np.sqrt(square - radius * radius)
        low, high = (x * away + y * radius, y * away - x * radius), (x * away - y * radius, y * away + x * radius)
        around = ~(radius * radius < real(0.98) * square - real(1e-30))
    else:
        end_x, end_y = ((shapes[one + 2 + k] - cell[:, k].astype(real)) - pose[:, k] for k in range(2))
        turn, along = x * end_y - y * end_x, x * end_x + y * end_y
        ends = ((x, y), (end_x, end_y))
        low, high = (
            tuple(np.where(turn >= 0, a, b) for a, b in zip(*pair, strict=True)) for pair in (ends, ends[::-1])
        )
        around = (np.abs(turn) <= real(-1e-3) * along) | ((x == 0) & (y == 0)) | ((end_x == 0) & (end_y == 0))
    begin, last = (
        np.floor(np.where(around, real(0), turned(*end) + real(by)) * real(SIGHTS / 4))
        for end, by in ((low, -APART), (high, APART))
    )
    none = (i == ignored) | ~np.isfinite(x)
    end = np.where(around, SIGHTS, np.where(last < begin, last + SIGHTS, last) + 1)
    return np.where(none, 0, begin).astype(int), np.where(none, 0, end).astype(int)


def meet_disc(dx: np.ndarray, dy: np.ndarray, x: np.ndarray, y: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Return the distances along rays to discs, infinite where none is met, and cosines of angles of incidence.

    Inside a disc they are 0 and 1. Places are relative to the rays' origins.
    """
    real = dx.dtype.type
    along, aside = dx * x + dy * y, dx * y - dy * x
    square = (radius - aside) * (radius + aside)
    half_chord = np.sqrt(np.where(square > 0, square, real(0)))
    near, far = along - half_chord, along + half_chord
    cosine = np.where(radius > 0, half_chord / np.where(radius > 0, radius, real(1)), real(1))
    t = np.where(near > 0, near, real(0))
    return np.stack([np.where((square >= 0) & (far >= 0), t, real(np.inf)), np.where(near > 0, cosine, real(1))])


def meet_box(
    dx: np.ndarray, dy: np.ndarray, x: np.ndarray, y: np.ndarray, cosine: np.ndarray, sine: np.ndarray,
    half_length: np.ndarray, half_width: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Return the same for boxes with these cosines and sines of their yaws."""
    real = dx.dtype.type
    u, v = cosine * dx + sine * dy, cosine * dy - sine * dx
    p, q = -(cosine * x + sine * y), -(cosine * y - sine * x)
    sides = []
    for speed, place, half in ((u, p, half_length), (v, q, half_width)):
        fast, begin = np.abs(speed), np.where(speed < 0, -place, place)
        inverse = 1 / np.where(fast < TINY, real(TINY), fast)
        flat = np.where(np.abs(place) <= half, real(-np.inf), real(np.inf))
        sides.append((
            np.where(fast < TINY, flat, (-half - begin) * inverse),
            np.where(fast < TINY, real(np.inf), (half - begin) * inverse), fast,
        ))  # fmt: skip
    (in_u, out_u, fast_u), (in_v, out_v, fast_v) = sides
    into, out = np.where(in_u > in_v, in_u, in_v), np.where(out_u < out_v, out_u, out_v)
    t, straight = np.where(into > 0, into, real(0)), np.where(in_u > in_v, fast_u, fast_v)
    return np.stack([np.where((into <= out) & (out >= 0), t, real(np.inf)), np.where(into > 0, straight, real(1))])


def meet_segment(
    dx: np.ndarray, dy: np.ndarray, x: np.ndarray, y: np.ndarray, end_x: np.ndarray, end_y: np.ndarray
) -> np.ndarray:
    """Return the same of segments; a ray along one meets its nearer end."""
    real = dx.dtype.type
    along, end_along = dx * x + dy * y, dx * end_x + dy * end_y
    aside, end_aside = dx * y - dy * x, dx * end_y - dy * end_x
    width, length = end_aside - aside, end_along - along
    nearer, farther = np.where(along < end_along, along, end_along), np.where(along < end_along, end_along, along)
    across = along - aside / np.where(width == 0, real(1), width) * length
    clipped = np.where(across < nearer, nearer, np.where(across > farther, farther, across))
    on_line = np.where(nearer > 0, nearer, np.where(farther < 0, real(-1), real(0)))
    t = np.where(width == 0, np.where(aside == 0, on_line, real(-1)), clipped)
    straight = np.abs(width) / np.sqrt(np.where(width == 0, real(1), width * width + length * length))
    meets = ((aside <= 0) & (end_aside >= 0)) | ((aside >= 0) & (end_aside <= 0))
    return np.stack([np.where(meets & (t >= 0), t, real(np.inf)), straight])


def nearest_shape(
    shapes: np.ndarray, world: np.ndarray, crowd: structs.Crowd, cell: np.ndarray, pose: np.ndarray, ray: np.ndarray,
    t: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Return the nearest of the shapes along M rays and of obstacles at distances t.

    ``shapes``: the shapes of all worlds, flat; ``world``: (2 M, 2) numbers of the rays' particles; ``cell``: (M, 2)
    cells of the rays' origins; ``pose``: (M, 4) fractions of these cells, and headings; ``ray``: (M, 2) cosines and
    sines of bearings; ``t``: (M,) distances in cells.

    Returns:
        (2, M) distances, and cosines of angles of incidence, 2 where no shape is nearer than t.
    """
    dx, dy = ray_direction(pose, ray)
    index, ignored = world[1::2].T
    one = index.astype(np.int64) * crowd.stride
    nearest = np.stack([t, np.full_like(t, 2)])
    kinds = (DISC,) * crowd.discs + (BOX,) * crowd.boxes + (SEGMENT,) * crowd.segments
    real = pose.dtype.type
    for i, numbers in enumerate(kinds):
        a = [shapes[one + k] for k in range(numbers)]
        x, y = ((a[k] - cell[:, k].astype(real)) - pose[:, k] for k in range(2))
        if i < crowd.discs:
            met = meet_disc(dx, dy, x, y, a[2])
        elif i < crowd.discs + crowd.boxes:
            met = meet_box(dx, dy, x, y, *a[2:6])
        else:
            ends = ((a[2 + k] - cell[:, k].astype(real)) - pose[:, k] for k in range(2))
            met = meet_segment(dx, dy, x, y, *ends)
        nearest = np.where((met[0] < nearest[0]) & (i != ignored), met, nearest)
        one = one + numbers
    return nearest


def shape_distance(
    shapes: np.ndarray, world: np.ndarray, crowd: structs.Crowd, cell: np.ndarray,
    point: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Return the distances from points to the nearest shape that each particle sees, infinite without one, 0 inside.

    The (M, 2) points are relative to the cells.
    """
    real = point.dtype.type
    nearest = np.full(len(point), real(np.inf))
    index, ignored = world[1::2].T
    one = index.astype(np.int64) * crowd.stride
    kinds = (DISC,) * crowd.discs + (BOX,) * crowd.boxes + (SEGMENT,) * crowd.segments
    for i, numbers in enumerate(kinds):
        a = [shapes[one + k] for k in range(numbers)]
        x, y = ((a[k] - cell[:, k].astype(real)) - point[:, k] for k in range(2))
        if i < crowd.discs:
            away = np.sqrt(x * x + y * y) - a[2]
        elif i < crowd.discs + crowd.boxes:
            u, v = np.abs(a[2] * x + a[3] * y) - a[4], np.abs(a[2] * y - a[3] * x) - a[5]
            out_u, out_v = np.where(u > 0, u, real(0)), np.where(v > 0, v, real(0))
            away = np.where(x == x, np.sqrt(out_u * out_u + out_v * out_v), real(np.nan))
        else:
            to_x, to_y = (((a[2 + k] - cell[:, k].astype(real)) - point[:, k]) - at for k, at in enumerate((x, y)))
            square = to_x * to_x + to_y * to_y
            part = -(x * to_x + y * to_y) / np.where(square > 0, square, real(1))
            on = np.where(part > 0, np.where(part < 1, part, real(1)), real(0))
            off_x, off_y = x + on * to_x, y + on * to_y
            away = np.sqrt(off_x * off_x + off_y * off_y)
        nearest = np.where((away < nearest) & (i != ignored), away, nearest)
        one = one + numbers
    return np.where(nearest > 0, nearest, real(0))
