"""The standard deviation of a scan's ranges, from the scan alone.

On a straight wall the inverse range is ``a cos(bearing) + b sin(bearing)``, so two neighbours predict a beam's inverse
range, at any incidence. The median deviation from this prediction measures the noise, since corners, edges and moving
objects are at less than half of all beams. Ranges that come in steps have at least the deviation of rounding, step /
sqrt(12).
"""

from __future__ import annotations

import functools

import numpy as np

from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Scanner, hits

# Most beams of a scan that are evaluated, and least beams for an estimate.
_PLACES, _LEAST = 120, 12
# Median absolute value of a normal error [standard deviations].
_MEDIAN = 0.6745
# Neighbours whose ranges differ by more than this share do not belong to one surface.
_STEP = 0.35
# Noise is at least this [m], and rounded up to the next power of this base, so that scans of a call form few groups.
LEAST_NOISE, LARGEST_NOISE, ROOT = 0.01, 0.08, 2**0.5
# Noise that is assumed where a scan has too few beams for an estimate [m].
ASSUMED_NOISE = 0.02
# Ranges come in steps if all differences are multiples of a step of at least this size [m], to within this share of it.
_LEAST_STEP, _ODD = 1e-3, 0.02


def scan_noise(ranges: np.ndarray, scanner: Scanner) -> np.ndarray:
    """Return the standard deviations (S,) of the ranges of (S, K) readings [m], NaN where too few beams measure it."""
    if scanner.count < 3 or not len(ranges):
        return np.full(len(ranges), np.nan)
    place, left, right = _neighbors(scanner)
    readings = ranges.astype(np.float64)
    hit = hits(readings, scanner.range_min, scanner.range_max)
    z = [readings[:, place + k] for k in (-1, 0, 1)]
    use = hit[:, place - 1] & hit[:, place] & hit[:, place + 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        expected = 1 / (left / z[0] + right / z[2])
        # Standard deviation of the difference, with the errors of both neighbours times their derivatives.
        share = np.sqrt(1 + ((expected / z[0]) ** 2 * left) ** 2 + ((expected / z[2]) ** 2 * right) ** 2)
        use &= (expected > 0) & (np.abs(z[0] - z[1]) < _STEP * z[1]) & (np.abs(z[2] - z[1]) < _STEP * z[1])
        off = np.where(use, np.abs(z[1] - expected) / share, np.inf)
    number = use.sum(axis=1)
    middle = np.sort(off, axis=1)[np.arange(len(off)), np.maximum(number - 1, 0) // 2]
    rounding = _range_steps(np.where(use, z[1], np.inf)) / np.sqrt(12)
    return np.where(number >= _LEAST, np.maximum(middle / _MEDIAN, rounding), np.nan)


@functools.lru_cache(maxsize=16)
def _neighbors(scanner: Scanner) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the places (P,) at which noise is measured, and the weights of their neighbours on a straight wall."""
    bearing, place = scanner.bearings, np.arange(1, scanner.count - 1)
    place = place[:: -(-len(place) // _PLACES)]
    before, after = bearing[place] - bearing[place - 1], bearing[place + 1] - bearing[place]
    whole = np.sin(before + after)
    with np.errstate(divide="ignore", invalid="ignore"):
        return place, np.sin(after) / whole, np.sin(before) / whole


def _range_steps(ranges: np.ndarray) -> np.ndarray:
    """Return the step (S,) in which ranges (S, K) come [m], 0 without one; infinite ranges do not count."""
    with np.errstate(invalid="ignore"):
        gap = np.diff(np.sort(ranges, axis=1), axis=1)
    gap = np.where(np.isfinite(gap) & (gap > 0.5 * _LEAST_STEP), gap, np.inf)
    step = gap.min(axis=1, initial=np.inf)
    with np.errstate(invalid="ignore"):
        multiple = gap / step[:, None]
        odd = np.isfinite(gap) & (np.abs(multiple - np.rint(multiple)) > _ODD)
    known = np.isfinite(gap).sum(axis=1) >= _LEAST
    return np.where(known & (step > _LEAST_STEP) & ~odd.any(axis=1), step, 0.0)


def match_noise(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the noise of matches (S,): the larger noise of both scans, rounded up to a step; NaN is unknown."""
    both = np.fmax(first, second)
    both = np.clip(np.where(np.isnan(both), ASSUMED_NOISE, both), LEAST_NOISE, LARGEST_NOISE)
    noise: np.ndarray = LEAST_NOISE * ROOT ** np.ceil(np.log(both / LEAST_NOISE) / np.log(ROOT) - 0.1)
    return noise


def map_noise(scans: np.ndarray, grid: OccupancyGrid) -> np.ndarray:
    """Return the noise of matches (S,) of scans in a map, including the rounding of its surfaces to cells."""
    both = np.hypot(np.where(np.isnan(scans), ASSUMED_NOISE, scans), grid.resolution / np.sqrt(12))
    return match_noise(both, both)
