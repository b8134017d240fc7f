"""Floors of known geometry for features: rooms along a corridor, doors, square pillars, poles and clutter.

A floor consists of straight walls and circles, so that ranges are exact and every line, corner, door, hallway and pole
is known. A seed determines the floor.
"""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gpusense._util.typing import Floats

# Thickness of walls [m].
WALL = 0.12
# Rays per pass.
_CHUNK = 4096


@dataclass
class Floor:
    """Walls, circles and doors of a floor.

    Attributes:
        walls: (W, 4) ends x, y, x, y of walls [m].
        circles: (C, 3) centres x, y and radii [m]; every circle is a pole.
        doors: (D, 4) jambs x, y, x, y of passages, one per face of the wall [m].
        hallways: (H, 5) start x, y and end x, y of axes, and widths [m].
        free: (R, 4) rectangles x, y, x, y in which a robot may stand [m].
    """

    walls: Floats
    circles: Floats
    doors: Floats
    hallways: Floats
    free: Floats

    @functools.cached_property
    def corners(self) -> Floats:
        """(N, 4) vertex, bisector and opening angle of both sides of all corners between walls with a common end."""
        found = []
        both = [(wall, wall[[2, 3, 0, 1]]) for wall in self.walls]
        for i, j in itertools.permutations(range(len(both)), 2):
            for p, q in itertools.product(both[i], both[j]):
                if np.abs(p[2:] - q[:2]).max() < 1e-6:
                    found.append(corner_between(p, q))
        return np.array(found).reshape(-1, 4)

    def cast(self, poses: Floats, bearings: Floats) -> tuple[Floats, NDArray[np.int64]]:
        """Return exact ranges (N, K) [m], infinite without a surface, and the surface's index: walls, then circles."""
        angle = poses[:, 2, None] + bearings
        x, y = (np.broadcast_to(poses[:, i, None], angle.shape).ravel() for i in (0, 1))
        ranges, surface = np.empty(angle.size), np.empty(angle.size, np.int64)
        flat = angle.ravel()
        for first in range(0, angle.size, _CHUNK):
            part = slice(first, first + _CHUNK)
            ranges[part], surface[part] = self._nearest(x[part], y[part], np.cos(flat[part]), np.sin(flat[part]))
        return ranges.reshape(angle.shape), surface.reshape(angle.shape)

    def _nearest(self, x: Floats, y: Floats, c: Floats, s: Floats) -> tuple[Floats, NDArray[np.int64]]:
        """Return range and surface of rays (R,)."""
        x, y, c, s = (value[:, None] for value in (x, y, c, s))
        x0, y0, x1, y1 = self.walls.T
        along_x, along_y = x1 - x0, y1 - y0
        with np.errstate(divide="ignore", invalid="ignore"):
            across = c * along_y - s * along_x
            far = ((x0 - x) * along_y - (y0 - y) * along_x) / across
            place = ((x0 - x) * s - (y0 - y) * c) / across
        wall = np.where((far > 0) & (place >= 0) & (place <= 1), far, np.inf)
        middle = (self.circles[:, 0] - x) * c + (self.circles[:, 1] - y) * s
        beside = (self.circles[:, 0] - x) * s - (self.circles[:, 1] - y) * c
        half = self.circles[:, 2] ** 2 - beside**2
        near = middle - np.sqrt(np.maximum(half, 0))
        circle = np.where((half >= 0) & (near > 0), near, np.inf)
        both = np.concatenate([wall, circle], axis=1)
        nearest = both.argmin(axis=1)
        return both[np.arange(len(both)), nearest], nearest

    def clearance(self, xy: Floats) -> Floats:
        """Return the distance (N,) of points (N, 2) to the nearest surface [m]."""
        start, along = self.walls[:, :2], self.walls[:, 2:] - self.walls[:, :2]
        off = xy[:, None] - start
        place = np.clip((off * along).sum(axis=2) / np.square(along).sum(axis=1), 0, 1)
        wall = np.hypot(*np.moveaxis(off - place[..., None] * along, 2, 0)).min(axis=1, initial=np.inf)
        gap = np.hypot(*np.moveaxis(xy[:, None] - self.circles[:, :2], 2, 0)) - self.circles[:, 2]
        return np.minimum(wall, gap.min(axis=1, initial=np.inf))

    def poses(self, count: int, seed: int, clearance: float = 0.3) -> Floats:
        """Return (count, 3) poses drawn from the free rectangles, at least ``clearance`` [m] from all surfaces."""
        rng = np.random.default_rng([seed, 1])
        area = (self.free[:, 2] - self.free[:, 0]) * (self.free[:, 3] - self.free[:, 1])
        found: list[Floats] = []
        while sum(map(len, found)) < count:
            box = self.free[rng.choice(len(self.free), 4 * count, p=area / area.sum())]
            xy = box[:, :2] + rng.random((len(box), 2)) * (box[:, 2:] - box[:, :2])
            found.append(xy[self.clearance(xy) >= clearance])
        xy = np.concatenate(found)[:count]
        return np.column_stack([xy, rng.uniform(-math.pi, math.pi, count)])


def corner_between(p: Floats, q: Floats) -> list[float]:
    """Return vertex, bisector and opening angle to the left of walls p and q, where q begins at the end of p."""
    one, two = p[2:] - p[:2], q[2:] - q[:2]
    before, after = math.atan2(one[1], one[0]), math.atan2(two[1], two[0])
    opening = math.pi - math.remainder(after - before, 2 * math.pi)
    return [float(p[2]), float(p[3]), math.remainder(after + opening / 2, 2 * math.pi), opening]


@dataclass
class _Plan:
    """Surfaces of a floor under construction."""

    walls: list[tuple[float, float, float, float]] = field(default_factory=list)
    circles: list[tuple[float, float, float]] = field(default_factory=list)
    doors: list[tuple[float, float, float, float]] = field(default_factory=list)
    free: list[tuple[float, float, float, float]] = field(default_factory=list)

    def path(self, *points: tuple[float, float]) -> None:
        """Add walls from point to point."""
        self.walls += [(*one, *two) for one, two in itertools.pairwise(points)]

    def box(self, x: float, y: float, width: float, depth: float, turn: float) -> None:
        """Add the four sides of a box about (x, y)."""
        c, s = math.cos(turn), math.sin(turn)
        corners = [(i * width / 2, j * depth / 2) for i, j in ((1, 1), (-1, 1), (-1, -1), (1, -1), (1, 1))]
        self.path(*((x + c * a - s * b, y + s * a + c * b) for a, b in corners))


def floor_plan(seed: int, *, rooms: int = 3, clutter: bool = True) -> Floor:
    """Return a floor: a corridor along x with rooms on both sides, each behind an open, half open or closed door.

    Args:
        seed: Seed of all sizes and places.
        rooms: Rooms on each side of the corridor.
        clutter: True for rooms with square pillars, poles and boxes.
    """
    rng = np.random.default_rng([seed, 0])
    width, plan = rng.uniform(1.6, 2.6), _Plan()
    length = 0.0
    jambs: dict[int, list[float]] = {}
    for side in (1, -1):
        x, jambs[side] = 0.0, []
        for _ in range(rooms):
            size = rng.uniform(4.0, 7.0), rng.uniform(3.0, 6.0)
            jambs[side] += _room(plan, rng, x, side, width / 2, size, clutter)
            x += size[0] + WALL
        length = max(length, x)
    for side, places in jambs.items():
        y = side * width / 2
        ends = [0.0, *places, length]
        plan.walls += [(one, y, two, y) for one, two in zip(ends[::2], ends[1::2], strict=True)]
    plan.walls += [(x, -width / 2, x, width / 2) for x in (0.0, length)]
    plan.free.append((0.3, -width / 2 + 0.3, length - 0.3, width / 2 - 0.3))
    return Floor(
        np.array(plan.walls), np.array(plan.circles).reshape(-1, 3), np.array(plan.doors).reshape(-1, 4),
        np.array([[0.0, 0.0, length, 0.0, width]]), np.array(plan.free),
    )  # fmt: skip


def _room(
    plan: _Plan, rng: np.random.Generator, x: float, side: int, half: float, size: tuple[float, float], clutter: bool
) -> list[float]:
    """Add a room and its door; return the jambs of the door along the corridor, none if it is closed."""
    near, far = side * (half + WALL), side * (half + WALL + size[1])
    kind = rng.choice(["open", "half open", "closed"], p=[0.5, 0.3, 0.2])
    wide = rng.uniform(0.8, 1.2)
    left = x + rng.uniform(0.4, size[0] - wide - 0.4)
    plan.free.append((x + 0.3, min(near, far) + 0.3, x + size[0] - 0.3, max(near, far) - 0.3))
    if clutter:
        _clutter(plan, rng, (x, min(near, far), x + size[0], max(near, far)))
    if kind == "closed":
        plan.path((x, near), (x, far), (x + size[0], far), (x + size[0], near), (x, near))
        return []
    plan.path((left, near), (x, near), (x, far), (x + size[0], far), (x + size[0], near), (left + wide, near))
    for jamb in (left, left + wide):
        plan.walls.append((jamb, side * half, jamb, near))
    for face in (side * half, near):
        plan.doors.append((left, face, left + wide, face))
    if kind == "half open":
        # The leaf turns about the left jamb into the room.
        swing = side * math.radians(rng.uniform(50, 110))
        plan.walls.append((left, near, left + wide * math.cos(swing), near + wide * math.sin(swing)))
    return [left, left + wide]


def _clutter(plan: _Plan, rng: np.random.Generator, room: tuple[float, float, float, float]) -> None:
    """Add a square pillar, poles and boxes to a room, apart from one another and from its walls."""
    placed: list[tuple[float, float, float]] = []
    for kind in ["pillar", "pole", "pole", "box"]:
        reach = {"pillar": 0.35, "pole": 0.2, "box": 0.45}[kind]
        for _ in range(20):
            margin = reach + 0.6
            x, y = rng.uniform(room[0] + margin, room[2] - margin), rng.uniform(room[1] + margin, room[3] - margin)
            if all(math.hypot(x - a, y - b) > reach + other + 0.4 for a, b, other in placed):
                break
        else:
            continue
        placed.append((x, y, reach))
        if kind == "pole":
            plan.circles.append((x, y, rng.uniform(0.05, 0.2)))
        elif kind == "pillar":
            side = rng.uniform(0.35, 0.5)
            plan.box(x, y, side, side, 0.0)
        else:
            plan.box(x, y, rng.uniform(0.3, 0.6), rng.uniform(0.3, 0.6), rng.uniform(0, math.pi))
