"""Exact rays, walked cell by cell in rational arithmetic; nothing here imports ``gpusense``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import mpmath as mp
from support.oracles import as_fraction, placed

Number = int | float | Fraction


@dataclass(frozen=True)
class Ray:
    """A ray in cell units: the origin's cell and its fraction, a direction, and a limit."""

    cell: tuple[int, int]
    frac: tuple[Number, Number]
    direction: tuple[Number, Number]
    limit: Number

    def moved(self, x: Number, y: Number, turn: Number) -> Ray:
        """Return the ray with its origin moved and its direction turned by a small angle."""
        px = self.cell[0] + Fraction(self.frac[0]) + Fraction(x)
        py = self.cell[1] + Fraction(self.frac[1]) + Fraction(y)
        cell = math.floor(px), math.floor(py)
        dx, dy, angle = *map(Fraction, self.direction), Fraction(turn)
        turned = (dx - angle * dy, dy + angle * dx)
        return Ray(cell, (px - cell[0], py - cell[1]), turned, self.limit)


def _gone(index: int, step: int, size: int) -> bool:
    """Return whether an index outside [0, size) moves away."""
    return (index < 0 and step < 0) or (index >= size and step > 0)


@dataclass(frozen=True)
class Hit:
    """End of a walk: the correctly rounded distance, and the face: cell and axis of the last step."""

    t: float
    face: tuple[int, int, str] | None


def walk(occupied: Sequence[Sequence[bool]], ray: Ray, outside_occupied: bool = False) -> Hit:
    """Return the end of Amanatides and Woo's walk in integers, so that no operation rounds.

    Cells are half-open. At a tie, where the ray passes a corner, the step in x comes first. The limit is checked before
    the cell. The distance is in units of the direction's length, 1 up to rounding. For fractions a / one and
    directions d / unit, boundary k is at (k * one + a) * unit / (one * d).
    """
    rows, cols = len(occupied), len(occupied[0])
    x, y = ray.cell
    fx, fy, dx, dy, limit = (Fraction(v) for v in (*ray.frac, *ray.direction, ray.limit))
    step_x, step_y = (1 if dx >= 0 else -1), (1 if dy >= 0 else -1)
    one = fx.denominator * fy.denominator
    unit = dx.denominator * dy.denominator
    at_x, at_y = int((1 - fx if dx >= 0 else fx) * one), int((1 - fy if dy >= 0 else fy) * one)
    speed_x, speed_y = int(abs(dx) * unit), int(abs(dy) * unit)
    scale, farthest = unit * limit.denominator, one * limit.numerator
    far_x, far_y = farthest * speed_x, farthest * speed_y
    ahead, speed, axis = 0, 1, "origin"
    while True:
        if 0 <= x < cols and 0 <= y < rows:
            if occupied[y][x]:
                return Hit(ahead * unit / (one * speed), (x, y, axis))
        elif outside_occupied:
            return Hit(ahead * unit / (one * speed), (x, y, axis))
        elif _gone(x, step_x, cols) or _gone(y, step_y, rows):
            return Hit(float(limit), None)
        if at_x * speed_y <= at_y * speed_x if speed_x and speed_y else speed_x:
            if at_x * scale >= far_x:
                return Hit(float(limit), None)
            ahead, speed, axis = at_x, speed_x, "x"
            x, at_x = x + step_x, at_x + one
        elif speed_y:
            if at_y * scale >= far_y:
                return Hit(float(limit), None)
            ahead, speed, axis = at_y, speed_y, "y"
            y, at_y = y + step_y, at_y + one
        else:
            return Hit(float(limit), None)


_SIDES = (1e-8, 1e-6, 1e-4, 1e-3, 0.01, 0.03, 0.1, 0.3, 1.0)


def backward_error_is_small(
    occupied: Sequence[Sequence[bool]],
    ray: Ray,
    result: float,
    *,
    move: float,
    turn: float,
    tolerance: float,
    outside_occupied: bool = False,
) -> bool:
    """Return whether a ray with its origin moved by at most ``move`` and turned by ``turn`` has a given range.

    Walk the rays on both sides. On a face the range varies continuously with the ray, so any value between two rays
    that end on the same face belongs to a ray between them.
    """
    dx, dy = float(ray.direction[0]), float(ray.direction[1])
    faces: dict[Any, list[float]] = {}
    for side in (0.0, *_SIDES, *(-s for s in _SIDES)):
        shifts = [(-dy * move * side, dx * move * side), (move * side, 0.0), (0.0, move * side), (0.0, 0.0)]
        for shift in shifts:
            for angle in {0.0, turn * side, -turn * side}:
                hit = walk(occupied, ray.moved(*shift, angle), outside_occupied)
                if abs(hit.t - result) <= tolerance:
                    return True
                faces.setdefault(hit.face, []).append(hit.t)
    return any(face is not None and min(t) <= result <= max(t) for face, t in faces.items())


def world_ray(
    pose: Sequence[float],
    bearing: float,
    *,
    origin: Sequence[float],
    resolution: float,
    range_max: float,
    mount: Sequence[float] = (0.0, 0.0, 0.0),
) -> Ray:
    """Return the ray of a beam in a frame computed by mpmath; the limit is in exact cells."""
    x, y, _, _ = placed(pose, origin, resolution, mount)
    angle = mp.mpf(float(pose[2])) + mp.mpf(float(mount[2])) + mp.mpf(float(bearing)) - mp.mpf(float(origin[2]))
    fx, fy = as_fraction(x), as_fraction(y)
    cell = math.floor(fx), math.floor(fy)
    direction = as_fraction(mp.cos(angle)), as_fraction(mp.sin(angle))
    return Ray(cell, (fx - cell[0], fy - cell[1]), direction, Fraction(range_max) / Fraction(resolution))
