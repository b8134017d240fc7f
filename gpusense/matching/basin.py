"""Poses to which ICP between scans converges from several starts, in both directions.

Information of pairs is tested against noise, and so little of it is left where few pairs constrain a direction that
this direction counts as not observed, among furniture as in a corridor. Starts on both sides tell them apart: among
furniture they end at one pose, and the scans exchanged have the inverse pose. Along a corridor they stay apart. Where
doors that look alike hold them at a wrong pose, the exchanged scans, which see others at their edges, mostly do not.
"""

from __future__ import annotations

import numpy as np

from gpusense._util.angles import wrapped
from gpusense._util.typing import Precision
from gpusense.backends.base import Backend
from gpusense.matching.icp import IcpPairs, space_of
from gpusense.matching.icp_with_search import to_sensor
from gpusense.matching.options import MatchOptions
from gpusense.matching.points import scan_points
from gpusense.matching.result import ScanMatch
from gpusense.world.scanner import Scanner

# Distances of starts from a pose, along each of its directions [m].
_STARTS = (-0.4, 0.4)
# Poses within this distance are one [m].
_SAME = 0.1


def is_held(
    first: np.ndarray, second: np.ndarray, scanner: Scanner, match: ScanMatch, backend: Backend, precision: Precision,
    motions: tuple[np.ndarray | None, np.ndarray | None] = (None, None),
) -> np.ndarray:  # fmt: skip
    """Return (S,) whether starts along the lost directions of matches of (S, K) readings lead back to their poses.

    Starts are matched with the matches' noise. ``motions`` are (S, 3) motions during both scans, or None.
    """
    count, real = len(second), np.dtype(precision)
    before, during = motions
    moved = None if before is None or during is None else np.concatenate([before, during])
    points = scan_points(np.concatenate([first, second]), scanner, real, moved)
    one, two = np.arange(count), np.arange(count, 2 * count)
    pairs = np.concatenate([np.stack([one, two], axis=1), np.stack([two, one], axis=1)])
    starts = _starts(match)
    each = np.repeat(match.pose[:, None], starts.shape[1], axis=1) + starts
    shape = each.shape
    seen = to_sensor(each.reshape(-1, 3), scanner.mount[:2])
    guesses = np.concatenate([seen.reshape(shape), _inverse(seen).reshape(shape)])
    noise = np.tile(match.noise, 2)
    lock, space = space_of(backend)
    with lock, space:
        device = IcpPairs(backend, real, points, pairs, noise, space)
        rules = [
            MatchOptions(level, 1.0, (1.0, 1.0)).rules(most, points.gap)
            for level, (_, most) in zip(device.levels, device.most_points(), strict=True)
        ]
        found = device.run(np.arange(2 * count), guesses, rules, columns=4)[..., :3].astype(np.float64)
    there, back = found[:count].reshape(-1, 3), _inverse(found[count:].reshape(-1, 3))
    wanted = to_sensor(match.pose, scanner.mount[:2])[:, None]
    held = np.ones(count, bool)
    for poses in (there, back):
        off = poses.reshape(shape) - wanted
        turned = wrapped(off[..., 2]) * match.lever[:, None]
        held &= (np.hypot(np.hypot(off[..., 0], off[..., 1]), turned) <= _SAME).all(axis=1)
    return held


def _starts(match: ScanMatch) -> np.ndarray:
    """Return (S, M, 3) offsets of starts along the lost directions of matches."""
    axes = np.array(match.directions)
    axes[:, :, 2] /= match.lever[:, None]
    axes = np.where((match.eigenvalues == 0)[:, :, None], axes, 0.0)
    along = [distance * axes[:, k] for k in range(3) for distance in _STARTS]
    return np.stack(along, axis=1)


def _inverse(pose: np.ndarray) -> np.ndarray:
    """Return (L, 3) poses of first frames in second frames from the inverse poses."""
    x, y, theta = pose.T
    c, s = np.cos(theta), np.sin(theta)
    return np.stack([-c * x - s * y, s * x - c * y, -theta], axis=1)
