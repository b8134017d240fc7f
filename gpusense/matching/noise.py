"""The standard deviation of a scan's ranges, from the scan alone.

On a straight wall the inverse range is ``a cos(bearing) + b sin(bearing)``, so two neighbours predict a beam's inverse
range, at any incidence. The median deviation from this prediction measures the noise, since corners, edges and moving
objects are at less than half of all beams. Ranges that come in steps have at least the deviation of rounding, step /
sqrt(12).
"""

from __future__ import annotations

import functools

import numpy as np

from gpusense.matching.columns import chosen, column_of, larger, smaller, values_of
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Scanner, hits

# Most beams of a scan that are evaluated, and least beams for an estimate.
_PLACES, _LEAST = 120, 12
# Median absolute value of a normal error [standard deviations].
_MEDIAN = 0.6745
_ROOT_OF_12 = float(np.sqrt(12))
# Neighbours whose ranges differ by more than this share do not belong to one surface.
_STEP = 0.35
# Noise is at least this [m], and rounded up to the next power of this base, so that scans of a call form few groups.
LEAST_NOISE, LARGEST_NOISE, ROOT = 0.01, 0.08, 2**0.5
_LOG_OF_ROOT = float(np.log(ROOT))
# Noise that is assumed where a scan has too few beams for an estimate [m].
ASSUMED_NOISE = 0.02
# Ranges come in steps if all differences are multiples of a step of at least this size [m], to within this share of it.
_LEAST_STEP, _ODD = 1e-3, 0.02


def scan_noise(ranges: np.ndarray, scanner: Scanner) -> np.ndarray:
    """Return the standard deviations (S,) of the ranges of (S, K) readings [m], NaN where too few beams measure it."""
    if scanner.count < 3 or not len(ranges):
        return np.full(len(ranges), np.nan)
    places, left, right = _neighbors(scanner)
    readings = ranges.astype(np.float64, copy=False)
    # Comparisons with readings that are no hits are false.
    known = np.where(hits(readings, scanner.range_min, scanner.range_max), readings, np.nan)
    before, here, after = (known[:, part] for part in places)
    with np.errstate(all="ignore"):
        expected = 1 / (left / before + right / after)
        # Standard deviation of the difference, with the errors of both neighbours times their derivatives.
        share = np.sqrt(
            1 + np.square(np.square(expected / before) * left) + np.square(np.square(expected / after) * right)
        )
        limit = _STEP * here
        use = expected > 0
        use &= np.abs(before - here) < limit
        use &= np.abs(after - here) < limit
        off = np.where(use, np.abs(here - expected) / share, np.inf)
        number = np.add.reduce(use, axis=1, dtype=np.intp)
        off.sort(axis=1)
        middle = np.arange(0, off.size, off.shape[1]) + np.maximum(number - 1, 0) // 2
        deviation = off.take(middle) / _MEDIAN
        rounding = _rounding(np.where(use, here, np.inf), deviation)
        return np.where(number >= _LEAST, np.maximum(deviation, rounding), np.nan)


@functools.lru_cache(maxsize=16)
def _neighbors(scanner: Scanner) -> tuple[tuple[slice, ...], np.ndarray, np.ndarray]:
    """Return slices of the beams before, at and after (P,) places, and the neighbours' weights on a straight wall."""
    bearing, last = scanner.bearings, scanner.count - 1
    step = -(-(last - 1) // _PLACES)
    places = slice(0, last - 1, step), slice(1, last, step), slice(2, last + 1, step)
    before, here, after = (bearing[part] for part in places)
    whole = np.sin((here - before) + (after - here))
    with np.errstate(divide="ignore", invalid="ignore"):
        return places, np.sin(after - here) / whole, np.sin(here - before) / whole


def _rounding(ranges: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """Return the deviation (S,) of rounding to the steps in which ranges (S, K) come [m], 0 without steps.

    Infinite ranges do not count. Call it where invalid operations are ignored.

    Args:
        ranges: The ranges [m].
        deviation: (S,) deviations; where the rounding to a step is smaller, the result may be 0.
    """
    ranges.sort(axis=1)
    gap = ranges[:, 1:] - ranges[:, :-1]
    # Differences of infinite ranges are NaN.
    gap = np.where(gap > 0.5 * _LEAST_STEP, gap, np.inf)
    step = np.minimum.reduce(gap, axis=1, initial=np.inf)
    rounding = step / _ROOT_OF_12
    known = (step > _LEAST_STEP) & (rounding > deviation)
    if not known.any():
        return np.zeros(len(step))
    multiple = gap / step[:, None]
    # Infinite gaps are infinite multiples, or NaN, and neither is odd.
    odd = np.logical_or.reduce(np.abs(multiple - np.rint(multiple)) > _ODD, axis=1)
    known &= np.add.reduce(gap < np.inf, axis=1, dtype=np.intp) >= _LEAST
    return np.where(known & ~odd, rounding, 0.0)


def match_noise(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the noise of matches (S,): the larger noise of both scans, rounded up to a step.

    Args:
        first: (S,) or (1,) noise of the reference scans [m]; NaN is unknown.
        second: (S,) noise of the second scans.
    """
    both = column_of(np.fmax(first, second))
    # NaN differs from itself.
    both = smaller(larger(chosen(both == both, both, ASSUMED_NOISE), LEAST_NOISE), LARGEST_NOISE)
    steps = np.ceil(np.log(both / LEAST_NOISE) / _LOG_OF_ROOT - 0.1)
    return values_of(LEAST_NOISE * np.power(ROOT, steps))


def map_noise(scans: np.ndarray, grid: OccupancyGrid) -> np.ndarray:
    """Return the noise of matches (S,) of scans in a map, including the rounding of its surfaces to cells."""
    both = np.hypot(np.where(np.isnan(scans), ASSUMED_NOISE, scans), grid.resolution / np.sqrt(12))
    return match_noise(both, both)
