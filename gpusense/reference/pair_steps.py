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
    """Return how far ranges are from those that their neighbours predict on a straight wall.

    The unit is the standard deviation of this difference, with the errors of both neighbours times their derivatives.
    Call it where invalid operations are ignored.

    ``before``: (S, P) ranges of the beams before [m]; NaN is unknown; ``here``: (S, P) ranges; ``after``: (S, P) ranges
    of the beams after; ``left``: (P,) weights of the neighbours before; ``right``: (P,) weights of the neighbours
    after.

    Returns:
        (S, P), infinite where the three are on different surfaces.
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

    Infinite ranges do not count. Call it where invalid operations are ignored.

    ``ranges``: the ranges [m]; ``deviation``: (S,) deviations; where the rounding to a step is smaller, the result may
    be 0.
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
    """Return the standard deviations (S,) of the ranges of scans [m], NaN where too few beams measure it.

    ``known``: (S, K) ranges [m], NaN where a reading is none; ``places``: the beams before, at and after (P,) places;
    ``left``: (P,) weights of the neighbours before; ``right``: (P,) weights of the neighbours after.
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
    """Return the level of noise of a pair: the first one whose largest noise is not exceeded, or the last one.

    ``noise``: larger noise of both scans [m], NaN where neither measures it; ``largest``: (L,) largest noise of each
    level; ``assumed``: the level of unknown noise.
    """
    return assumed if np.isnan(noise) else min(int(np.searchsorted(largest, noise)), len(largest) - 1)


def place_points(
    readings: np.ndarray, beam: np.ndarray, nearest: float, farthest: float, real: np.dtype
) -> tuple[np.ndarray, float]:
    """Return the points (N, 4) of a scan's hits, and the sum of squared ranges.

    ``readings``: (K,) readings [m]; ``beam``: (K, 4) cosines, sines, bearings in [0, 2 pi), and places of the readings;
    beams come by bearing; ``nearest``: least range [m]; ``farthest``: least larger reading that is no range [m].
    """
    z = readings[beam[:, 3].astype(int)]
    kept = is_hit(z, nearest, farthest) & (z > NEAREST)
    z, cosine, sine, bearing = z[kept], *beam[kept, :3].T
    squares = float(np.append(0.0, np.square(z)).cumsum()[-1])
    return np.stack([z * cosine, z * sine, bearing, z], axis=1).astype(real), squares
