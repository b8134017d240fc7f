"""Directions of its pose that a scan observes by itself, whatever the map.

Distances to a map know nothing of lines: the ends of a corridor's walls in the map, or gaps between cells, seem to
constrain the position along the corridor. A scan matched with itself has the information of its own lines.
"""

from __future__ import annotations

import numpy as np

from gpusense.backends import Backend
from gpusense.matching.icp import IcpPairs, space_of
from gpusense.matching.options import MatchOptions
from gpusense.matching.points import scan_points
from gpusense.matching.uncertainty import LEAST_PAIRS, Uncertainty, spread, symmetric
from gpusense.world.scanner import Scanner


def own_uncertainty(
    ranges: np.ndarray, pose: np.ndarray, variance: np.ndarray, scanner: Scanner, backend: Backend, real: np.dtype,
    options: MatchOptions,
) -> Uncertainty:  # fmt: skip
    """Return the uncertainty of poses that the lines of the scans leave.

    Args:
        ranges: (S, K) readings [m].
        pose: (S, 3) poses of the robot in the world.
        variance: (S,) variance of the points' distances from the map [m^2].
        scanner: The scanner.
        backend: The device.
        real: Precision.
        options: Capture radius and noise.
    """
    points = scan_points(ranges, scanner, real)
    everything = np.arange(len(pose))
    lock, space = space_of(backend)
    with lock, space:
        device = IcpPairs(backend, real, points, np.stack([everything, everything], axis=1), options.noise, space)
        rules = options.rules(int(points.counts.max(initial=0)), points.gap)
        result = device.run(everything, np.zeros((len(pose), 1, 3)), rules)[:, 0].astype(np.float64)
        space.wait()
    turned = _turned(pose[:, 2], scanner.mount[:2])
    information, doubt = (turned @ symmetric(result[:, at : at + 6]) @ turned.transpose(0, 2, 1) for at in (6, 12))
    least = np.full(len(pose), LEAST_PAIRS)
    lever = points.rms_range(everything)
    return spread(information, doubt * options.noise**2, variance, result[:, 19], lever, least)


def with_own(field: Uncertainty, own: Uncertainty) -> Uncertainty:
    """Return what fields and the scans' own lines leave: the sum of the covariances, and the fewer directions."""
    less = own.observed.sum(axis=1) < field.observed.sum(axis=1)
    # Infinite parts of opposite signs: the direction that the scan itself does not observe prevails.
    with np.errstate(invalid="ignore"):
        covariance = field.covariance + own.covariance
    covariance = np.where(np.isnan(covariance), own.covariance, covariance)
    pick = less[:, None, None]
    return Uncertainty(
        covariance, np.where(less[:, None], own.eigenvalues, field.eigenvalues),
        np.where(pick, own.directions, field.directions), np.where(less[:, None], own.observed, field.observed),
    )  # fmt: skip


def _turned(heading: np.ndarray, mount: tuple[float, float]) -> np.ndarray:
    """Return (S, 3, 3) derivatives that turn information on sensors' poses into that on robots' poses in the world."""
    c, s, (x, y) = np.cos(heading), np.sin(heading), mount
    zero, one = np.zeros(len(c)), np.ones(len(c))
    return np.stack([c, -s, zero, s, c, zero, zero - y, zero + x, one], axis=1).reshape(-1, 3, 3)
