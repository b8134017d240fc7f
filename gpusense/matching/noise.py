"""The standard deviation of a scan's ranges, from the scan alone.

On a straight wall the inverse range is ``a cos(bearing) + b sin(bearing)``, so two neighbours predict a beam's inverse
range, at any incidence. The median deviation from this prediction measures the noise, since corners, edges and moving
objects are at less than half of all beams. Ranges that come in steps have at least the deviation of rounding, step /
sqrt(12).
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np

from gpusense.matching.columns import Column, chosen, column_of, larger, smaller, values_of
from gpusense.reference.pair_steps import noise_of
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Scanner, classify_ranges

# Most beams of a scan that are evaluated.
_PLACES = 120
# Noise is at least this [m], and rounded up to the next power of this base, so that scans of a call form few groups.
LEAST_NOISE, LARGEST_NOISE, ROOT = 0.01, 0.08, 2**0.5
_LOG_OF_ROOT = float(np.log(ROOT))
# Noise that is assumed where a scan has too few beams for an estimate [m].
ASSUMED_NOISE = 0.02


def scan_noise(ranges: np.ndarray, scanner: Scanner) -> np.ndarray:
    """Return the standard deviations (S,) of the ranges of (S, K) readings [m], NaN where too few beams measure it."""
    if scanner.count < 3 or not len(ranges):
        return np.full(len(ranges), np.nan)
    known = np.where(classify_ranges(ranges, scanner.range_min, scanner.range_max)[0], ranges, np.nan)
    if not beams_in_order(scanner):
        known = known[:, _order_of(scanner)]
    return noise_of(known.astype(np.float64, copy=False), *neighbors(scanner))


def beams_in_order(scanner: Scanner) -> bool:
    """Return whether beams come by bearing, from the widest gap or from -pi on."""
    return bool((np.diff(_order_of(scanner)) > 0).all())


@functools.lru_cache(maxsize=16)
def _order_of(scanner: Scanner) -> np.ndarray:
    """Return the order of beams by bearing, from the widest gap on, or from -pi if beams cover a full turn."""
    bearing = np.mod(scanner.bearings + math.pi, 2 * math.pi)
    order = np.argsort(bearing, kind="stable")
    step = np.mod(np.diff(bearing[order], append=bearing[order[0]]), 2 * math.pi)
    widest = int(step.argmax()) if len(step) else 0
    is_full = not len(step) or step[widest] < 1.5 * np.median(step)
    return order if is_full else np.roll(order, -1 - widest)


def whole_noise(ranges: np.ndarray, scanner: Scanner) -> np.ndarray:
    """Return the standard deviations (S,) of ranges from all beams and their neighbours by bearing [m].

    :func:`scan_noise` takes at most 120 beams, which depend on the order of beams.
    """
    if scanner.count < 3 or not len(ranges):
        return np.full(len(ranges), np.nan)
    known = np.where(classify_ranges(ranges, scanner.range_min, scanner.range_max)[0], ranges, np.nan)
    order = _order_of(scanner)
    step = np.mod(np.diff(scanner.bearings[order], append=scanner.bearings[order[0]]), 2 * math.pi)
    before = np.roll(step, 1)
    whole = np.sin(before + step)
    # Neighbours across a gap predict nothing.
    near = np.maximum(before, step) < 3.5 * np.median(step)
    with np.errstate(divide="ignore", invalid="ignore"):
        left, right = (np.where(near, np.sin(part) / whole, np.nan) for part in (step, before))
    around = known.astype(np.float64, copy=False)[:, [order[-1], *order, order[0]]]
    return noise_of(around, (slice(0, -2), slice(1, -1), slice(2, None)), left, right)


@functools.lru_cache(maxsize=16)
def neighbors(scanner: Scanner) -> tuple[tuple[slice, ...], np.ndarray, np.ndarray]:
    """Return slices of the beams before, at and after (P,) places in order, and their weights on a straight wall."""
    bearing, last = scanner.bearings[_order_of(scanner)], scanner.count - 1
    step = -(-(last - 1) // _PLACES)
    places = slice(0, last - 1, step), slice(1, last, step), slice(2, last + 1, step)
    before, here, after = (bearing[part] for part in places)
    whole = np.sin((here - before) + (after - here))
    with np.errstate(divide="ignore", invalid="ignore"):
        return places, np.sin(after - here) / whole, np.sin(here - before) / whole


def match_noise(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the noise of matches (S,): the larger noise of both scans [m], rounded up to a step; NaN is unknown."""
    both = column_of(np.fmax(first, second))
    # NaN differs from itself.
    both = smaller(larger(chosen(both == both, both, ASSUMED_NOISE), LEAST_NOISE), LARGEST_NOISE)
    return values_of(LEAST_NOISE * np.power(ROOT, _step_of(both)))


def _step_of(noise: Column) -> Column:
    """Return the powers of the base up to which noise is rounded; noise is from the least to the largest one [m]."""
    return np.ceil(np.log(noise / LEAST_NOISE) / _LOG_OF_ROOT - 0.1)


class NoiseLevels(NamedTuple):
    """The values of the noise of a match.

    Attributes:
        noise: The values, ascending [m].
        largest: Largest noise of scans that is rounded to each of them; larger noise belongs to the last one.
        assumed: Level of a match whose scans have too few beams for an estimate.
    """

    noise: list[float]
    largest: list[float]
    assumed: int


@functools.cache
def noise_levels() -> NoiseLevels:
    """Return the values that ``match_noise`` returns."""
    steps = range(int(_step_of(LARGEST_NOISE)) + 1)
    noise = [float(LEAST_NOISE * np.power(ROOT, np.float64(step))) for step in steps]
    return NoiseLevels(noise, [_largest_of(step) for step in steps], int(_step_of(ASSUMED_NOISE)))


def _largest_of(step: int) -> float:
    """Return the largest number whose ``_step_of`` is a step."""
    noise = LEAST_NOISE * ROOT ** (step + 0.1)
    while _step_of(noise) > step:
        noise = math.nextafter(noise, 0)
    while _step_of(math.nextafter(noise, 1)) <= step:
        noise = math.nextafter(noise, 1)
    return noise


def map_noise(scans: np.ndarray, grid: OccupancyGrid) -> np.ndarray:
    """Return the noise of matches (S,) of scans in a map, including the rounding of its surfaces to cells."""
    both = np.hypot(np.where(np.isnan(scans), ASSUMED_NOISE, scans), grid.resolution / np.sqrt(12))
    return match_noise(both, both)
