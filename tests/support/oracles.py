"""Truths without any code or formula of the library: frames, densities at 60 digits, end points. Every oracle
implements the definition of a model plainly and slowly. mpmath evaluates densities, and ``ray_oracles`` walks rays;
nothing here imports ``gpusense``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import mpmath as mp
import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.stats import expon, norm

mp.mp.dps = 60

# ------------------------------------------------------------------------------------------------------- frames


def placed(
    pose: Sequence[float], origin: Sequence[float], resolution: float, mount: Sequence[float] = (0.0, 0.0, 0.0)
) -> tuple[Any, Any, Any, Any]:
    """Return the sensor's x, y in cells and its heading's cosine and sine in the grid's frame, without the mount's
    yaw."""
    x, y, theta = (mp.mpf(float(v)) for v in pose)
    ox, oy, yaw = (mp.mpf(float(v)) for v in origin)
    mx, my = mp.mpf(float(mount[0])), mp.mpf(float(mount[1]))
    wx = x + mp.cos(theta) * mx - mp.sin(theta) * my - ox
    wy = y + mp.sin(theta) * mx + mp.cos(theta) * my - oy
    cos, sin, cell = mp.cos(yaw), mp.sin(yaw), mp.mpf(float(resolution))
    return (cos * wx + sin * wy) / cell, (cos * wy - sin * wx) / cell, mp.cos(theta - yaw), mp.sin(theta - yaw)


def as_fraction(value: Any) -> Fraction:
    """Return the largest multiple of 2^-120 up to an mpmath number."""
    return Fraction(int(mp.floor(mp.ldexp(value, 120))), 1 << 120)


# --------------------------------------------------------------------------------------------------- beam mixture


@dataclass(frozen=True)
class Mixture:
    """Evaluates the beam model of one reading, book section 6.3, by mpmath."""

    z_hit: float
    z_short: float
    z_max: float
    z_rand: float
    sigma: float
    rate: float
    range_max: float

    @classmethod
    def of(cls, parameters: Any, range_max: float) -> Mixture:
        """Return the mixture of any object with the parameters as attributes."""
        p = parameters
        return cls(p.z_hit, p.z_short, p.z_max, p.z_rand, p.sigma_hit, p.lambda_short, range_max)

    def hit(self, z: Any, expected: Any) -> Any:
        """Return the normal density at z, mean z*, truncated to [0, range_max] and renormalised."""
        sigma, top = mp.mpf(self.sigma), mp.mpf(self.range_max)
        root = sigma * mp.sqrt(2)
        mass = (mp.erf((top - expected) / root) - mp.erf(-expected / root)) / 2
        return mp.exp(-(((z - expected) / sigma) ** 2) / 2) / (sigma * mp.sqrt(2 * mp.pi)) / mass

    def short(self, z: Any, expected: Any) -> Any:
        """Return the exponential density on [0, z*], uniform for rate 0, nothing for z* = 0."""
        if expected == 0 or not 0 <= z <= expected:
            return mp.mpf(0)
        rate = mp.mpf(self.rate)
        return rate * mp.exp(-rate * z) / -mp.expm1(-rate * expected) if rate else 1 / expected

    def density(self, z: float, expected: float) -> Any:
        """Return the continuous part at z in [0, range_max)."""
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
        """Return the logarithm of the density, -inf where the density is 0."""
        p = self.density(z, expected)
        return mp.log(p) if p else -mp.inf

    def log_densities(self, z: np.ndarray, expected: np.ndarray) -> np.ndarray:
        """Return log densities in float64 for ordinary parameters: rate > 0, and a moderate sigma."""
        hit = norm.pdf(z, expected, self.sigma) / (
            norm.cdf(self.range_max, expected, self.sigma) - norm.cdf(0, expected, self.sigma)
        )
        short = expon.pdf(z, scale=1 / self.rate) / np.maximum(expon.cdf(expected, scale=1 / self.rate), 1e-300)
        short = np.where((z <= expected) & (expected > 0), short, 0)
        return np.log(self.z_hit * hit + self.z_short * short + self.z_rand / self.range_max)

    def log_reading(self, z: float, expected: float, range_min: float = 0.0) -> Any:
        """Return the term of any reading: 0 for a missing one, log z_max for a max reading, else the log density."""
        kind = classify(z, self.range_max, range_min)
        if kind == "missing" or (kind == "max" and self.z_max == 0):
            return mp.mpf(0)
        return mp.log(mp.mpf(self.z_max)) if kind == "max" else self.log_density(z, expected)


def classify(z: float, range_max: float, range_min: float = 0.0) -> str:
    """Return ``"missing"``, ``"max"`` or ``"hit"``."""
    if np.isnan(z) or z < 0 or z < range_min or (z == 0 and range_min > 0):
        return "missing"
    return "max" if z >= range_max else "hit"


def informative(ranges: Iterable[float], range_max: float, range_min: float, z_max: float) -> list[int]:
    """Return the indices of informative readings."""
    kinds = [classify(float(z), range_max, range_min) for z in ranges]
    return [k for k, kind in enumerate(kinds) if kind == "hit" or (kind == "max" and z_max > 0)]


# ------------------------------------------------------------------------------------------------ likelihood field


class Field:
    """Evaluates table 6.3 in float64: end points, distances to the nearest occupied cell's centre, densities."""

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
        """Return (N, K, 2) in cells: lines 4 and 5 of the table, then into the grid's frame."""
        x, y, theta = (poses[:, i, None] for i in range(3))
        angle = theta + self.mount[2] + bearings
        wx = x - self.origin[0] + self.mount[0] * np.cos(theta) - self.mount[1] * np.sin(theta) + ranges * np.cos(angle)
        wy = y - self.origin[1] + self.mount[1] * np.cos(theta) + self.mount[0] * np.sin(theta) + ranges * np.sin(angle)
        yaw = self.origin[2]
        gx, gy = np.cos(yaw) * wx + np.sin(yaw) * wy, np.cos(yaw) * wy - np.sin(yaw) * wx
        return np.stack([gx, gy], axis=-1) / self.resolution

    def cell_distance(self, col: np.ndarray, row: np.ndarray) -> np.ndarray:
        """Return the capped distance of cells, max_distance outside."""
        rows, cols = self.distances.shape
        inside = (col >= 0) & (col < cols) & (row >= 0) & (row < rows)
        held = self.distances[np.clip(row, 0, rows - 1), np.clip(col, 0, cols - 1)]
        return np.where(inside, held, self.parameters.max_distance)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of points in cells, by the parameters' interpolation."""
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
        """Return (N, K) log-likelihoods of the readings, and the distances of their end points to a cell's edge."""
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
