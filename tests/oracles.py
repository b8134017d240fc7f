"""Truths that share no code and no formula with the library: exact rays, densities at 60 digits, end points, frames.

Every oracle follows the definitions of the models from scratch, slowly and plainly. Rays are walked cell by cell in
rational arithmetic; densities are evaluated by mpmath; nothing here imports ``gpusense``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import mpmath as mp
import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.stats import expon, norm

mp.mp.dps = 60

Number = int | float | Fraction

# ---------------------------------------------------------------------------------------------------------- rays


@dataclass(frozen=True)
class Ray:
    """A ray in cell units: the origin's cell and its fraction, a direction, and how far it is followed."""

    cell: tuple[int, int]
    frac: tuple[Number, Number]
    direction: tuple[Number, Number]
    limit: Number

    def moved(self, x: Number, y: Number, turn: Number) -> Ray:
        """The ray with its origin moved and its direction turned by a small angle."""
        px = self.cell[0] + Fraction(self.frac[0]) + Fraction(x)
        py = self.cell[1] + Fraction(self.frac[1]) + Fraction(y)
        cell = math.floor(px), math.floor(py)
        dx, dy, angle = *map(Fraction, self.direction), Fraction(turn)
        turned = (dx - angle * dy, dy + angle * dx)
        return Ray(cell, (px - cell[0], py - cell[1]), turned, self.limit)


def _gone(index: int, step: int, size: int) -> bool:
    """Whether an index outside [0, size) moves farther away."""
    return (index < 0 and step < 0) or (index >= size and step > 0)


def fraction_walk(occupied: np.ndarray, ray: Ray, outside_occupied: bool = False) -> Fraction | None:
    """Distance to the first occupied cell by Amanatides and Woo's walk in fractions; None where nothing is nearer.

    Cells are half-open. A tie, the ray through a corner, steps in x first. The limit is looked at before the cell.
    The distance is in units of the direction's length, which is 1 but for rounding.
    """
    rows, cols = occupied.shape
    x, y = ray.cell
    dx, dy = map(Fraction, ray.direction)
    step_x, step_y = (1 if dx >= 0 else -1), (1 if dy >= 0 else -1)
    fx, fy = map(Fraction, ray.frac)
    to_x, to_y = (1 - fx if dx >= 0 else fx), (1 - fy if dy >= 0 else fy)
    crossed_x = crossed_y = 0
    t = Fraction(0)
    while True:
        if 0 <= x < cols and 0 <= y < rows:
            if occupied[y, x]:
                return t
        elif outside_occupied:
            return t
        elif _gone(x, step_x, cols) or _gone(y, step_y, rows):
            return None
        when_x = (crossed_x + to_x) / abs(dx) if dx else None
        when_y = (crossed_y + to_y) / abs(dy) if dy else None
        if when_x is None and when_y is None:
            return None
        if when_y is None or (when_x is not None and when_x <= when_y):
            t, x, crossed_x = when_x, x + step_x, crossed_x + 1
        else:
            t, y, crossed_y = when_y, y + step_y, crossed_y + 1
        if t >= Fraction(ray.limit):
            return None


@dataclass(frozen=True)
class Hit:
    """Where a walk ended: the distance (correctly rounded), and the face: cell, and the axis that was stepped."""

    t: float
    face: tuple[int, int, str] | None


def walk(occupied: Sequence[Sequence[bool]], ray: Ray, outside_occupied: bool = False) -> Hit:
    """The same walk in integers, which is exact too and ten times as fast; a test holds it to ``fraction_walk``.

    With fractions a / one and directions d / unit, the boundary k lies at (k * one + a) * unit / (one * d).
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
    """Whether a range is that of a ray whose origin is moved by at most ``move`` and direction turned by ``turn``.

    Rays on both sides of the asked one are walked. On one face the range varies continuously with the ray, so any
    value between two rays that end on the same face belongs to a ray between them.
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


# ------------------------------------------------------------------------------------------------------- frames


def placed(
    pose: Sequence[float], origin: Sequence[float], resolution: float, mount: Sequence[float] = (0.0, 0.0, 0.0)
) -> tuple[Any, Any, Any, Any]:
    """Sensor x and y in cells, heading cosine and sine, in the grid's frame; the mount's yaw is left to the beams."""
    x, y, theta = (mp.mpf(float(v)) for v in pose)
    ox, oy, yaw = (mp.mpf(float(v)) for v in origin)
    mx, my = mp.mpf(float(mount[0])), mp.mpf(float(mount[1]))
    wx = x + mp.cos(theta) * mx - mp.sin(theta) * my - ox
    wy = y + mp.sin(theta) * mx + mp.cos(theta) * my - oy
    cos, sin, cell = mp.cos(yaw), mp.sin(yaw), mp.mpf(float(resolution))
    return (cos * wx + sin * wy) / cell, (cos * wy - sin * wx) / cell, mp.cos(theta - yaw), mp.sin(theta - yaw)


def as_fraction(value: Any) -> Fraction:
    """The multiple of 2^-120 just below an mpmath number."""
    return Fraction(int(mp.floor(mp.ldexp(value, 120))), 1 << 120)


def world_ray(
    pose: Sequence[float],
    bearing: float,
    *,
    origin: Sequence[float],
    resolution: float,
    range_max: float,
    mount: Sequence[float] = (0.0, 0.0, 0.0),
) -> Ray:
    """The ray of a beam, its frame made by mpmath; the limit is in exact cells."""
    x, y, _, _ = placed(pose, origin, resolution, mount)
    angle = mp.mpf(float(pose[2])) + mp.mpf(float(mount[2])) + mp.mpf(float(bearing)) - mp.mpf(float(origin[2]))
    fx, fy = as_fraction(x), as_fraction(y)
    cell = math.floor(fx), math.floor(fy)
    direction = as_fraction(mp.cos(angle)), as_fraction(mp.sin(angle))
    return Ray(cell, (fx - cell[0], fy - cell[1]), direction, Fraction(range_max) / Fraction(resolution))


# --------------------------------------------------------------------------------------------------- beam mixture


@dataclass(frozen=True)
class Mixture:
    """The beam model of one reading, book section 6.3, by mpmath."""

    z_hit: float
    z_short: float
    z_max: float
    z_rand: float
    sigma: float
    rate: float
    range_max: float

    @classmethod
    def of(cls, parameters: Any, range_max: float) -> Mixture:
        """From any object with the parameters' names."""
        p = parameters
        return cls(p.z_hit, p.z_short, p.z_max, p.z_rand, p.sigma_hit, p.lambda_short, range_max)

    def hit(self, z: Any, expected: Any) -> Any:
        """Normal density at z, mean z*, truncated to [0, range_max] and renormalised."""
        sigma, top = mp.mpf(self.sigma), mp.mpf(self.range_max)
        root = sigma * mp.sqrt(2)
        mass = (mp.erf((top - expected) / root) - mp.erf(-expected / root)) / 2
        return mp.exp(-(((z - expected) / sigma) ** 2) / 2) / (sigma * mp.sqrt(2 * mp.pi)) / mass

    def short(self, z: Any, expected: Any) -> Any:
        """Exponential density on [0, z*], uniform for rate 0, nothing for z* = 0."""
        if expected == 0 or not 0 <= z <= expected:
            return mp.mpf(0)
        rate = mp.mpf(self.rate)
        return rate * mp.exp(-rate * z) / -mp.expm1(-rate * expected) if rate else 1 / expected

    def density(self, z: float, expected: float) -> Any:
        """The continuous part at z in [0, range_max)."""
        z_mp, e = mp.mpf(float(z)), mp.mpf(float(expected))
        total = mp.mpf(0)
        if self.z_hit:
            total += mp.mpf(self.z_hit) * self.hit(z_mp, e)
        if self.z_short:
            total += mp.mpf(self.z_short) * self.short(z_mp, e)
        if self.z_rand:
            total += mp.mpf(self.z_rand) / mp.mpf(self.range_max)
        return total

    def log_density(self, z: float, expected: float) -> Any:
        """Its logarithm, -inf where it is 0."""
        p = self.density(z, expected)
        return mp.log(p) if p else -mp.inf

    def log_densities(self, z: np.ndarray, expected: np.ndarray) -> np.ndarray:
        """The same in float64 for ordinary parameters: rate > 0, and a sigma that is neither tiny nor huge."""
        hit = norm.pdf(z, expected, self.sigma) / (
            norm.cdf(self.range_max, expected, self.sigma) - norm.cdf(0, expected, self.sigma)
        )
        short = expon.pdf(z, scale=1 / self.rate) / np.maximum(expon.cdf(expected, scale=1 / self.rate), 1e-300)
        short = np.where((z <= expected) & (expected > 0), short, 0)
        return np.log(self.z_hit * hit + self.z_short * short + self.z_rand / self.range_max)

    def log_reading(self, z: float, expected: float, range_min: float = 0.0) -> Any:
        """What any reading contributes: 0 if it says nothing, log z_max for a max reading, else the log density."""
        kind = classify(z, self.range_max, range_min)
        if kind == "missing" or (kind == "max" and self.z_max == 0):
            return mp.mpf(0)
        return mp.log(mp.mpf(self.z_max)) if kind == "max" else self.log_density(z, expected)


def classify(z: float, range_max: float, range_min: float = 0.0) -> str:
    """``"missing"``, ``"max"`` or ``"hit"``."""
    if np.isnan(z) or z < 0 or z < range_min or (z == 0 and range_min > 0):
        return "missing"
    return "max" if z >= range_max else "hit"


def informative(ranges: Iterable[float], range_max: float, range_min: float, z_max: float) -> list[int]:
    """Indices of readings that say something."""
    kinds = [classify(float(z), range_max, range_min) for z in ranges]
    return [k for k, kind in enumerate(kinds) if kind == "hit" or (kind == "max" and z_max > 0)]


# ------------------------------------------------------------------------------------------------ likelihood field


class Field:
    """Table 6.3 in float64: end points, distances to the nearest occupied cell's centre, densities."""

    def __init__(
        self,
        occupied: np.ndarray,
        resolution: float,
        origin: Sequence[float],
        parameters: Any,
        range_max: float,
        mount: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:
        self.resolution, self.origin, self.mount = resolution, origin, mount
        self.parameters, self.range_max = parameters, range_max
        if occupied.any():
            metres = distance_transform_edt(~occupied) * resolution
        else:
            metres = np.full(occupied.shape, np.inf)
        self.distances = np.minimum(metres, parameters.max_distance)

    def end_points(self, poses: np.ndarray, ranges: np.ndarray, bearings: np.ndarray) -> np.ndarray:
        """(N, K, 2) in cells: lines 4 and 5 of the table, then into the grid's frame."""
        x, y, theta = (poses[:, i, None] for i in range(3))
        angle = theta + self.mount[2] + bearings
        wx = x - self.origin[0] + self.mount[0] * np.cos(theta) - self.mount[1] * np.sin(theta) + ranges * np.cos(angle)
        wy = y - self.origin[1] + self.mount[1] * np.cos(theta) + self.mount[0] * np.sin(theta) + ranges * np.sin(angle)
        yaw = self.origin[2]
        gx, gy = np.cos(yaw) * wx + np.sin(yaw) * wy, np.cos(yaw) * wy - np.sin(yaw) * wx
        return np.stack([gx, gy], axis=-1) / self.resolution

    def cell_distance(self, col: np.ndarray, row: np.ndarray) -> np.ndarray:
        """Capped distance of cells, max_distance outside."""
        rows, cols = self.distances.shape
        inside = (col >= 0) & (col < cols) & (row >= 0) & (row < rows)
        held = self.distances[np.clip(row, 0, rows - 1), np.clip(col, 0, cols - 1)]
        return np.where(inside, held, self.parameters.max_distance)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Distance of points in cells, by the parameters' interpolation."""
        if self.parameters.interpolation == "nearest":
            cell = np.floor(points).astype(np.int64)
            return self.cell_distance(cell[..., 0], cell[..., 1])
        base = np.floor(points - 0.5).astype(np.int64)
        (u, v), col, row = np.moveaxis(points - 0.5 - base, -1, 0), base[..., 0], base[..., 1]
        return (
            (1 - u) * (1 - v) * self.cell_distance(col, row)
            + u * (1 - v) * self.cell_distance(col + 1, row)
            + (1 - u) * v * self.cell_distance(col, row + 1)
            + u * v * self.cell_distance(col + 1, row + 1)
        )

    def parts(
        self, poses: np.ndarray, ranges: np.ndarray, bearings: np.ndarray, range_min: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """(N, K) log-likelihoods of the readings, and how far their end points lie from a cell's edge."""
        p = self.parameters
        kinds = np.array([classify(float(z), self.range_max, range_min) for z in ranges], dtype=object)
        hits = np.flatnonzero(kinds == "hit")
        points = self.end_points(poses, ranges[hits].astype(np.float64), bearings[hits])
        d = self.distance(points)
        with np.errstate(divide="ignore"):
            near = np.log(p.z_hit) - np.log(p.sigma_hit) - np.log(2 * np.pi) / 2 - (d / p.sigma_hit) ** 2 / 2
            found = np.logaddexp(near, np.log(p.z_rand) - np.log(self.range_max))
        result, clear = np.zeros((len(poses), len(ranges))), np.full((len(poses), len(ranges)), np.inf)
        result[:, hits] = found
        if p.z_max > 0:
            result[:, kinds == "max"] = np.log(p.z_max)
        clear[:, hits] = np.abs(points - np.rint(points)).min(axis=-1)
        return result, clear
