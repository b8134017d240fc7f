"""Noise and points of scans, from their readings; see ``gpusense.matching.points``."""

from __future__ import annotations

import numpy as np

from gpusense.reference.reading_class import is_hit
from gpusense.reference.sorting import sort_numbers

# Median absolute value of a normal error [standard deviations].
MEDIAN = 0.6745
ROOT_OF_12 = float(np.sqrt(12))
# Neighbours whose ranges differ by more than this share do not belong to one surface.
LARGEST_STEP = 0.35
# Ranges come in steps if all differences are multiples of a step of at least this size [m], to within this share of it.
LEAST_STEP, ODD = 1e-3, 0.02
# Least beams for an estimate of noise.
LEAST_BEAMS = 12
# Points nearer than this have no bearing [m].
NEAREST = 1e-6


def deviation_of(
    before: np.ndarray, here: np.ndarray, after: np.ndarray, left: np.ndarray, right: np.ndarray
) -> np.ndarray:
    """Return how far (S, P) ranges are from their neighbours' predictions on a straight wall, in deviations.

    The deviation is of this difference, with the errors of both neighbours times their derivatives; it is infinite
    where the three are on different surfaces. ``left``, ``right``: (P,) weights of the ranges before and after. Call
    it where invalid operations are ignored.
    """
    expected = 1 / (left / before + right / after)
    share = np.sqrt(1 + np.square(np.square(expected / before) * left) + np.square(np.square(expected / after) * right))
    limit = LARGEST_STEP * here
    # Comparisons with NaN are false.
    use = expected > 0
    use &= np.abs(before - here) < limit
    use &= np.abs(after - here) < limit
    return np.where(use, np.abs(here - expected) / share, np.inf)


def rounding_of(ranges: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """Return the deviation (S,) of rounding to the steps in which ascending ranges (S, K) come [m], 0 without.

    Where it is below ``deviation`` (S,), it may be 0. Call it where invalid operations are ignored.
    """
    gap = ranges[:, 1:] - ranges[:, :-1]
    # Differences of infinite ranges are NaN.
    gap = np.where(gap > 0.5 * LEAST_STEP, gap, np.inf)
    step = np.minimum.reduce(gap, axis=1, initial=np.inf)
    rounding = step / ROOT_OF_12
    known = (step > LEAST_STEP) & (rounding > deviation)
    if not known.any():
        return np.zeros(len(step))
    multiple = gap / step[:, None]
    # Infinite gaps are infinite multiples, or NaN, and neither is odd.
    odd = np.logical_or.reduce(np.abs(multiple - np.rint(multiple)) > ODD, axis=1)
    known &= np.add.reduce(gap < np.inf, axis=1, dtype=np.intp) >= LEAST_BEAMS
    return np.where(known & ~odd, rounding, 0.0)


def noise_of(known: np.ndarray, places: tuple[slice, ...], left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the standard deviations (S,) of scans' ranges (S, K) [m], NaN where too few beams measure it.

    ``places``: the beams before, at and after (P,) places; ``left``, ``right``: (P,) weights of both neighbours.
    """
    before, here, after = (known[:, part] for part in places)
    with np.errstate(all="ignore"):
        off = deviation_of(before, here, after, left, right)
        use = off < np.inf
        number = np.add.reduce(use, axis=1, dtype=np.intp)
        ranges = np.where(use, here, np.inf)
        sort_numbers(off)
        sort_numbers(ranges)
        middle = np.arange(0, off.size, off.shape[1]) + np.maximum(number - 1, 0) // 2
        deviation = off.take(middle) / MEDIAN
        return np.where(number >= LEAST_BEAMS, np.maximum(deviation, rounding_of(ranges, deviation)), np.nan)


def level_of(noise: float, largest: np.ndarray, assumed: int) -> int:
    """Return the first level of ``largest`` noise (L,) not below a pair's, or the last; ``assumed`` for NaN."""
    return assumed if np.isnan(noise) else min(int(np.searchsorted(largest, noise)), len(largest) - 1)


def place_points(
    readings: np.ndarray, beam: np.ndarray, nearest: float, farthest: float, real: np.dtype
) -> tuple[np.ndarray, float]:
    """Return the points (N, 4) of the hits of (K,) readings, and the sum of squared ranges.

    ``beam``: (K, 4) cosines, sines, bearings in [0, 2 pi), ascending, and places of the readings; ``nearest``: least
    range; ``farthest``: least larger reading that is no range [m].
    """
    z = readings[beam[:, 3].astype(int)]
    kept = is_hit(z, nearest, farthest) & (z > NEAREST)
    z, cosine, sine, bearing = z[kept], *beam[kept, :3].T
    squares = float(np.append(0.0, np.square(z)).cumsum()[-1])
    return np.stack([z * cosine, z * sine, bearing, z], axis=1).astype(real), squares
