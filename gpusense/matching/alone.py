"""Directions of its pose that a scan observes by itself, whatever the map.

Distances to a map know nothing of lines: the ends of a corridor's walls in the map, or gaps between cells, seem to
constrain the position along the corridor. A scan matched with itself has the information of its own lines.
"""

from __future__ import annotations

import numpy as np

from gpusense.backends import Backend
from gpusense.matching.icp import LONG_WIDTH, WIDTH, IcpPairs, points_of_line, space_of
from gpusense.matching.options import MatchOptions
from gpusense.matching.points import scan_points
from gpusense.matching.uncertainty import observed_pairs, symmetric
from gpusense.world.scanner import Scanner


def own_information(
    ranges: np.ndarray, pose: np.ndarray, variance: np.ndarray, scanner: Scanner, backend: Backend, real: np.dtype,
    options: MatchOptions,
) -> np.ndarray:  # fmt: skip
    """Return the information (S, 3, 3) on poses that the lines of the scans leave, 0 along what they do not observe.

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
        device.fit_lines(max(WIDTH, LONG_WIDTH * options.noise))
        rules = options.rules(int(points.counts.max(initial=0)), points.gap)
        result = device.run(everything, np.zeros((len(pose), 1, 3)), rules)[:, 0].astype(np.float64)
        space.wait()
    turned = _turned(pose[:, 2], scanner.mount[:2])
    information, doubt = (turned @ symmetric(result[:, at : at + 6]) @ turned.transpose(0, 2, 1) for at in (6, 12))
    lever = points.rms_range(everything)
    lines = result[:, 19] / points_of_line(points.gap, options.noise, lever)
    found = observed_pairs(information, doubt, np.full(len(pose), options.noise**2), lever, lines)
    return found.information / np.maximum(variance, 1e-12)[:, None, None]


def _turned(heading: np.ndarray, mount: tuple[float, float]) -> np.ndarray:
    """Return (S, 3, 3) derivatives that turn information on sensors' poses into that on robots' poses in the world."""
    c, s, (x, y) = np.cos(heading), np.sin(heading), mount
    zero, one = np.zeros(len(c)), np.ones(len(c))
    return np.stack([c, -s, zero, s, c, zero, zero - y, zero + x, one], axis=1).reshape(-1, 3, 3)
