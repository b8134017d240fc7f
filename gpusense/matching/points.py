"""Points of scans, sorted by bearing, as the kernels of matching take them, and the standard deviation of their ranges.

On a straight wall the inverse range is ``a cos(bearing) + b sin(bearing)``, so two neighbours predict a beam's inverse
range, at any incidence. The median deviation from this prediction measures the noise, since corners, edges and moving
objects are at less than half of all beams. Ranges that come in steps have at least the deviation of rounding, step /
sqrt(12).
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gpusense.matching.columns import column_of, larger, square_root, values_of
from gpusense.reference.pair_steps import noise_of
from gpusense.world.deskew import sensor_points
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Scanner, classify_ranges

_FULL_TURN = 2 * math.pi
# Points nearer than this have no bearing [m].
_NEAREST = 1e-6
# Beams are dense up to this step [rad].
_DENSE = math.radians(2.5)
# Whole points as single items, by the bytes of a number.
_ITEMS = {size: np.dtype((np.void, 4 * size)) for size in (4, 8)}
# Largest step between the bearings of neighbours that hides nothing [steps of the scanner]: not a whole number, since
# rounding would decide on gaps of as many beams.
GAP = 3.25


@dataclass(frozen=True)
class ScanPoints:
    """End points of the hits of scans, in a frame at the sensor with axes parallel to the robot's."""

    point: np.ndarray  # (P, 4) x, y [m], bearing in [0, 2 pi) [rad] and range [m], sorted by bearing in each scan
    start: np.ndarray  # (S + 1,) first point of each scan
    gap: float  # largest step between the bearings of two neighbours that hides nothing [rad]
    squares: np.ndarray  # (S,) sums of squared ranges [m^2]

    @functools.cached_property
    def counts(self) -> np.ndarray:
        """(S,) points of each scan."""
        return self.start[1:] - self.start[:-1]

    def joined(self, others: ScanPoints) -> ScanPoints:
        """Return these scans followed by the second ones, with ``gap`` of the first."""
        start = np.concatenate([self.start, self.start[-1] + others.start[1:]]).astype(np.int32)
        squares = np.concatenate([self.squares, others.squares])
        return ScanPoints(np.concatenate([self.point, others.point]), start, self.gap, squares)

    def rms_range(self, scan: np.ndarray) -> np.ndarray:
        """Return the root mean square range of some scans, at least 1e-3 m."""
        squares, counts = column_of(self.squares[scan]), column_of(self.counts[scan])
        return values_of(larger(square_root(squares / larger(counts, 1)), 1e-3))


def dense_scanner(scanner: Scanner) -> Scanner:
    """Return a scanner with more beams over the same field of view, or the scanner itself if its beams are dense."""
    turned = np.sort(np.mod(scanner.bearings, _FULL_TURN))
    if len(turned) < 3:
        return scanner
    steps = np.diff(np.append(turned, turned[0] + _FULL_TURN))
    usual = float(np.median(steps))
    parts = math.ceil(usual / _DENSE)
    if parts < 2:
        return scanner
    inner = np.where(steps < GAP * usual, steps, 0.0)
    bearings = (turned[:, None] + inner[:, None] * np.arange(parts) / parts).ravel()
    bearings = np.unique(np.mod(bearings + math.pi, _FULL_TURN) - math.pi)
    return Scanner(bearings, scanner.range_max, scanner.range_min, scanner.mount)


def scan_points(ranges: np.ndarray, scanner: Scanner, real: np.dtype, motion: np.ndarray | None = None) -> ScanPoints:
    """Return the points of the hits of (S, K) readings [m]; the mount's yaw is added to bearings.

    With (S, 3) motions of the robot during the scans, see ``gpusense.world.deskew``, points are in the frames at the
    first beams.
    """
    if motion is not None and motion.any():
        return _moved_points(ranges, scanner, real, motion)
    order, bearing, cosine, sine, gap = beams_by_angle(scanner, real)
    z = ranges.take(order, axis=1)
    hit = classify_ranges(z, scanner.range_min, scanner.range_max)[0]
    hit &= z > _NEAREST
    z = np.where(hit, z, 0).astype(np.float64, copy=False)
    everything = np.empty((*z.shape, 4), real)
    np.multiply(z, cosine, out=everything[..., 0], casting="same_kind")
    np.multiply(z, sine, out=everything[..., 1], casting="same_kind")
    everything[..., 2] = bearing
    everything[..., 3] = z
    # View each point as a single item, so that a mask selects whole points.
    items = everything.view(_ITEMS[everything.itemsize])[..., 0]
    point = items[hit].view(real).reshape(-1, 4)
    return _points(point, hit, gap, _sums_of_squares(z))


def _sums_of_squares(z: np.ndarray) -> np.ndarray:
    """Return the sums (S,) of the squares of (S, K) numbers, added in their order as kernels add."""
    if len(z) == 1:
        # NumPy would add a single row by pairs; without numbers there is no last sum.
        return np.add.accumulate(np.square(z), axis=1)[:, -1:].sum(axis=1)
    return np.add.reduce(np.square(z.T, order="C"), axis=0)


@functools.lru_cache(maxsize=16)
def beams_by_angle(scanner: Scanner, real: np.dtype) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
    """Return the order of beams by their angles; angles in a precision, cosines, sines in this order; and the gap."""
    angle = np.mod(scanner.bearings + scanner.mount[2], _FULL_TURN)
    order = np.argsort(angle, kind="stable")
    angle = angle[order]
    rounded = angle.astype(real)
    return order, rounded, np.cos(angle), np.sin(angle), _gap_of(rounded)


def _gap_of(bearing: np.ndarray) -> float:
    """Return the largest step that hides nothing between ascending bearings."""
    steps = np.diff(bearing.astype(np.float64))
    return GAP * float(np.median(steps)) if len(steps) else _FULL_TURN


def _moved_points(ranges: np.ndarray, scanner: Scanner, real: np.dtype, motion: np.ndarray) -> ScanPoints:
    """Return the points of scans of a robot that moves."""
    hit = classify_ranges(ranges, scanner.range_min, scanner.range_max)[0] & (ranges > _NEAREST)
    place = sensor_points(ranges.astype(np.float64), scanner, motion)[hit]
    direction = np.mod(np.arctan2(place[:, 1], place[:, 0]), _FULL_TURN)
    point = np.column_stack([place, direction, np.hypot(*place.T)]).astype(real)
    order = np.lexsort((direction, np.nonzero(hit)[0]))
    squares = np.bincount(np.nonzero(hit)[0], np.square(place).sum(axis=1), len(hit))
    return _points(point[order], hit, _gap_of(np.sort(np.mod(scanner.bearings, _FULL_TURN))), squares)


def _points(point: np.ndarray, hit: np.ndarray, gap: float, squares: np.ndarray) -> ScanPoints:
    """Return points with the starts of their scans."""
    start = np.zeros(len(hit) + 1, np.int32)
    np.add.accumulate(np.add.reduce(hit, axis=1, dtype=np.int32), out=start[1:])
    return ScanPoints(np.ascontiguousarray(point), start, gap, squares)


# Most beams of a scan that are evaluated.
_PLACES = 120
# Noise is at least this [m], and rounded up to the next power of this base, so that scans of a call form few groups.
LEAST_NOISE, LARGEST_NOISE, ROOT = 0.01, 0.08, 2**0.5
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
    """Return the standard deviations (S,) of ranges [m] from all beams; ``scan_noise`` takes at most 120 of them."""
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


class NoiseLevels(NamedTuple):
    """The values of the noise of a match."""

    noise: np.ndarray  # the values, ascending [m]
    largest: np.ndarray  # largest noise of scans that is rounded to each of them; larger noise belongs to the last one
    assumed: int  # level of a match whose scans have too few beams for an estimate


@functools.cache
def noise_levels() -> NoiseLevels:
    """Return the values that ``match_noise`` returns, powers of the base; a tenth of a step is rounded down."""
    steps = range(math.ceil(math.log(LARGEST_NOISE / LEAST_NOISE, ROOT) - 0.1) + 1)
    noise, largest = (np.array([LEAST_NOISE * ROOT ** (step + more) for step in steps]) for more in (0, 0.1))
    return NoiseLevels(noise, largest, int(np.searchsorted(largest, ASSUMED_NOISE)))


def match_noise(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the noise of matches (S,): the larger noise of both scans [m], rounded up to a step; NaN is unknown."""
    levels, both = noise_levels(), np.fmax(first, second)
    both = np.where(np.isnan(both), ASSUMED_NOISE, both)
    step = np.minimum(np.searchsorted(levels.largest, both), len(levels.noise) - 1)
    noise: np.ndarray = levels.noise[step]
    return noise


def map_noise(scans: np.ndarray, grid: OccupancyGrid) -> np.ndarray:
    """Return the noise of matches (S,) of scans in a map, including the rounding of its surfaces to cells."""
    both = np.hypot(np.where(np.isnan(scans), ASSUMED_NOISE, scans), grid.resolution / np.sqrt(12))
    return match_noise(both, both)
