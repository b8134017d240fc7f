"""Readings of scans on the host: classed, thinned, and grouped by the rays that they share.

Readings are classed first and thinned afterwards, so that ``beams=60`` means 60 informative beams.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gpusense._util import checks
from gpusense._util.checks import integer, show
from gpusense.backends import Backend
from gpusense.world.likelihood import Likelihood
from gpusense.world.plausible import FirstScans
from gpusense.world.range_causes import NoReturn
from gpusense.world.scanner import Reading, Scanner, classify_ranges

Beams = int | Sequence[int] | np.ndarray | None


@functools.lru_cache(maxsize=256)
def _evenly(most: int, count: int) -> np.ndarray:
    """Return ``most`` evenly chosen places among ``count``."""
    return (np.arange(most) * count) // max(most, 1)


@dataclass(frozen=True)
class BeamChoice:
    """The beams that ``beams=`` chooses."""

    columns: np.ndarray  # beams that may be used
    most: int  # largest number of readings that are used, evenly chosen from more
    every: bool  # true if all beams are used

    @staticmethod
    def of(beams: Beams, count: int) -> BeamChoice:
        """Return the choice for a scanner of ``count`` beams."""
        if beams is None or isinstance(beams, (int, np.integer)):
            most = count if beams is None else min(int(beams), count)
            return BeamChoice(np.arange(count), most, most == count)
        columns = np.asarray(beams, np.intp)
        return BeamChoice(columns, len(columns), False)

    def used(self, informative: np.ndarray) -> np.ndarray:
        """Return which of the informative readings of a scan are used."""
        if len(self.columns) == len(informative):
            places = informative.nonzero()[0]
        else:
            places = self.columns.compress(informative.take(self.columns))
        if len(places) > self.most:
            places = places.take(_evenly(self.most, len(places)))
        used = np.zeros(len(informative), bool)
        used[places] = True
        return used

    def among(self, hit: np.ndarray, far: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return which of the ranges and of the informative max readings of (S, K) scans are used."""
        informative = hit | far
        if len(informative) == 1:
            used = self.used(informative[0])[None]
        else:
            used = np.stack([self.used(each) for each in informative])
        return hit & used, far & used


@dataclass(frozen=True)
class BeamSelection:
    """Rules that class, thin and group readings."""

    scanner: Scanner  # the scanner's geometry
    vectors: np.ndarray  # (K, 2) float64 cosines and sines of the bearings, the mount's yaw included
    z_max: float  # probability of a max reading; 0 makes it missing
    beams: Beams  # the beams that are used
    specialize: bool  # false keeps readings without information, and casts equal bearings separately
    max_is_range: bool = False  # evaluate finite max readings like ranges
    max_depends: bool = False  # the probability of a max reading depends on the pose, so such readings are evaluated
    map_size: float | None = None  # diagonal of the map [m]; None without a map

    @functools.cached_property
    def choice(self) -> BeamChoice:
        """The beams that are used."""
        return BeamChoice.of(self.beams, self.scanner.count)

    @functools.cached_property
    def columns(self) -> np.ndarray:
        """(K,) positions of all readings."""
        return np.arange(self.scanner.count)

    @functools.cached_property
    def of_complete_scan(self) -> tuple[np.ndarray, ...]:
        """Used (K,), columns, vectors, ray offsets, count and constant of a scan of ranges; see ``ClassedScans``."""
        used = self.choice.used(np.ones(self.scanner.count, bool))
        columns, count = used.nonzero()[0], np.count_nonzero(used)
        begins = np.arange(count + 1, dtype=np.int32)
        return used, columns, self.vectors.take(columns, axis=0), begins, np.array([count]), np.zeros(1)

    @functools.cached_property
    def separate(self) -> bool:
        """Return whether each reading has a separate ray, because all bearings differ or nothing is left out."""
        return not self.specialize or len(set(map(tuple, self.vectors.tolist()))) == len(self.vectors)

    @functools.cached_property
    def ray_of(self) -> np.ndarray:
        """Number (K,) of the ray of each bearing; equal bearings have the same one."""
        return np.unique(self.vectors, axis=0, return_inverse=True)[1].ravel()

    @functools.cached_property
    def limits(self) -> tuple[float, float]:
        """Least range, and least max reading [m]."""
        return self.scanner.range_min, self.scanner.range_max

    @functools.cached_property
    def first_scans(self) -> FirstScans:
        """The check of the scanner's first scans for implausible readings."""
        return self.scanner._first_scans

    @functools.cached_property
    def max_is_constant(self) -> bool:
        """Return whether max readings are added as a constant term instead of being evaluated."""
        return self.specialize and not self.max_depends

    @functools.cached_property
    def log_max(self) -> float:
        """Log of the probability of a max reading; 0 if max readings do not count."""
        return float(NoReturn(self.z_max).log_mass) if self.z_max > 0 else 0.0


def choose_beams(kinds: np.ndarray, beams: Beams, informative_max: bool) -> np.ndarray:
    """Return whether each reading is used: all, an even choice of ``beams`` informative ones, or chosen indices."""
    informative = (kinds == Reading.HIT) | ((kinds == Reading.MAX) & informative_max)
    return BeamChoice.of(beams, len(kinds)).used(informative)


@dataclass(frozen=True)
class ModelContext:
    """The device, and the rules for readings, of a scan model."""

    backend: Backend  # the device
    real: np.dtype  # precision
    rules: BeamSelection  # how readings are classed; they hold the scanner
    weights: Likelihood  # the book's likelihood, or the program whose weights are reproduced
    cubes: bool  # whether the model sums cubes of densities instead of logarithms
    temperature: float  # multiplies the sum over readings
    constant_term: float  # the first term of that sum
    possible: bool  # true if some range is possible at some pose


def check_beams(beams: Beams, count: int) -> Beams:
    """Validate ``beams=`` for a scanner of ``count`` beams."""
    if beams is None:
        return None
    if isinstance(beams, (int, np.integer)):
        return integer("beams", beams, low=0)
    try:
        indices = np.asarray(beams)
    except ValueError:
        indices = np.empty((0, 0))
    if indices.ndim != 1 or (indices.size and indices.dtype.kind not in "iu"):
        raise TypeError(f"beams: must be a number of beams or a list of beam indices, got {show(beams)}")
    outside = (indices < 0) | (indices >= count)
    if outside.any():
        raise ValueError(f"beams: indices must be in [0, {count}), got {indices[outside][0]}")
    return np.unique(indices)


class OmittedReadings(NamedTuple):
    """Readings of a scan that are not evaluated at every pose; they are counted when asked for."""

    hit: np.ndarray  # (K,) whether each reading is a range
    far: np.ndarray  # true if it is a max reading
    used: np.ndarray  # true if it is a used range
    used_max: np.ndarray  # true if it is a used max reading
    constant: np.ndarray  # true if it is part of the constant term
    informs: bool  # true if max readings have information: z_max > 0

    @property
    def missing(self) -> int:
        """Number of missing readings."""
        return int(np.count_nonzero(~(self.hit | self.far)))

    @property
    def ignored_max(self) -> int:
        """Number of max readings without information because z_max = 0."""
        return 0 if self.informs else int(np.count_nonzero(self.far))

    @property
    def constant_max(self) -> np.ndarray:
        """(C,) positions of the max readings in the constant term."""
        return self.constant.nonzero()[0]

    @property
    def thinned(self) -> int:
        """Number of informative readings left out by ``beams=``."""
        informative = self.hit | self.far if self.informs else self.hit
        return int(np.count_nonzero(informative & ~(self.used | self.used_max)))


class ClassedScans:
    """The M readings of S scans that are evaluated at every pose, one scan after the other.

    ``columns``: (M,) their positions in their scans, in the order of their rays; ``readings``: (M,) ranges [m], NaN
    (missing) and inf (max) only where nothing is left out; ``vectors``: (M, 2) cosines and sines of their bearings;
    ``rays``: (R, 2) the bearings that are cast; ``ray_offsets``: (R + 1,) first readings of rays; ``ray_counts``,
    ``counts``, ``constants``: (S,) rays, readings and constant terms of each scan; ``left_out``: the other readings of
    the last scan; ``shared``: whether several readings share a ray.
    """

    __slots__ = (
        "columns", "constants", "counts", "left_out", "most_rays", "most_readings", "ray_counts", "ray_offsets", "rays",
        "readings", "scans", "shared", "vectors",
    )  # fmt: skip

    def __init__(
        self, columns: np.ndarray, readings: np.ndarray, vectors: np.ndarray, rays: np.ndarray, ray_offsets: np.ndarray,
        ray_counts: np.ndarray, counts: np.ndarray, constants: np.ndarray, left_out: OmittedReadings,
    ) -> None:  # fmt: skip
        self.columns, self.readings, self.vectors = columns, readings, vectors
        self.rays, self.ray_offsets = rays, ray_offsets
        self.ray_counts, self.counts, self.constants, self.left_out = ray_counts, counts, constants, left_out
        self.scans = len(counts)
        self.most_readings = len(readings) if self.scans == 1 else max(counts.tolist(), default=0)
        self.shared = len(rays) < len(readings)
        self.most_rays = len(rays) if self.scans == 1 else max(ray_counts.tolist(), default=0)

    def part(self, begin: int, end: int) -> ClassedScans:
        """Return scans ``begin`` to ``end`` - 1."""
        if (begin, end) == (0, self.scans):
            return self
        rays = slice(int(self.ray_counts[:begin].sum()), int(self.ray_counts[:end].sum()))
        first = self.ray_offsets[rays.start : rays.stop + 1]
        chosen, scans = slice(first[0], first[-1]), slice(begin, end)
        return ClassedScans(
            self.columns[chosen], self.readings[chosen], self.vectors[chosen], self.rays[rays], first - first[0],
            self.ray_counts[scans], self.counts[scans], self.constants[scans], self.left_out,
        )  # fmt: skip

    def groups(self) -> Iterator[tuple[int, int]]:
        """Yield neighbouring scans that one program may score: all with shared rays, or none; empty ones alone."""
        kinds = np.where(self.counts == 0, 0, np.where(self.counts == self.ray_counts, 1, 2)).tolist()
        begin = 0
        while begin < len(kinds):
            end = begin + 1
            while kinds[begin] and end < len(kinds) and kinds[end] == kinds[begin]:
                end += 1
            yield begin, end
            begin = end


def check_ranges(ranges: object, scanner: Scanner) -> np.ndarray:
    """Return readings of one scan (K,) or of several (S, K), checked, in their float dtype."""
    readings = checks.as_array("ranges", ranges, masked=True)
    shape = ("S", scanner.count) if readings.ndim == 2 else (scanner.count,)
    return checks.array("ranges", readings, shape=shape, finite=False, dtype=None)


def class_scans(ranges: np.ndarray, rules: BeamSelection) -> ClassedScans:
    """Class, choose and group the readings of (S, K) scans, S > 0."""
    if rules.first_scans.left:
        rules.first_scans.look_at("ranges", ranges, rules.map_size)
    hit, far = classify_ranges(ranges, *rules.limits)
    if rules.max_is_range:
        finite = np.isfinite(ranges)
        hit, far = hit | (far & finite), far & ~finite
    # A search among bytes takes a tenth of the time of a reduction.
    if len(ranges) == 1 and rules.specialize and 0 not in hit.tobytes():
        return _of_complete_scan(ranges, (hit, far), rules)
    used, used_max = hit, far if rules.z_max > 0 else np.zeros(far.shape, bool)
    if not rules.choice.every:
        used, used_max = rules.choice.among(used, used_max)
    if rules.max_is_constant:
        evaluated, constant = used, used_max
    else:
        evaluated, constant = used | used_max | (not rules.specialize), np.zeros(far.shape, bool)
        ranges = np.where(used, ranges, np.where(used_max, np.inf, np.nan))
    constants = np.zeros(len(ranges))
    if 0 not in evaluated.tobytes():
        # Scans without gaps need no selection.
        counts = np.asarray([ranges.shape[1]] * len(ranges))
        columns, values, vectors = rules.columns, ranges.reshape(-1).astype(np.float64), rules.vectors
        if len(ranges) > 1:
            columns, vectors = np.tile(columns, len(ranges)), np.tile(vectors, (len(ranges), 1))
    else:
        places, counts = evaluated.reshape(-1).nonzero()[0], _numbers_of(evaluated)
        columns = places if len(ranges) == 1 else places % ranges.shape[1]
        values = ranges.reshape(-1).take(places).astype(np.float64)
        vectors = rules.vectors.take(columns, axis=0)
        if rules.max_is_constant and rules.log_max:
            constants += _numbers_of(constant) * rules.log_max
    scans = ClassedScans(
        columns, values, vectors, vectors, np.arange(len(columns) + 1, dtype=np.int32), counts, counts, constants,
        OmittedReadings(hit[-1], far[-1], used[-1], used_max[-1], constant[-1], rules.z_max > 0),
    )  # fmt: skip
    return scans if rules.separate else _separated(scans, rules.ray_of)


def _of_complete_scan(ranges: np.ndarray, classes: tuple[np.ndarray, np.ndarray], rules: BeamSelection) -> ClassedScans:
    """Return the chosen readings of a single scan in which every reading is a range."""
    used, columns, vectors, first, count, constants = rules.of_complete_scan
    hit, far = classes[0][0], classes[1][0]
    values = ranges[0] if rules.choice.every else ranges[0].take(columns)
    left_out = OmittedReadings(hit, far, used, far, far, rules.z_max > 0)
    scans = ClassedScans(
        columns, values.astype(np.float64), vectors, vectors, first, count, count, constants, left_out
    )  # fmt: skip
    return scans if rules.separate else _separated(scans, rules.ray_of)


def _separated(scans: ClassedScans, ray_of: np.ndarray) -> ClassedScans:
    """Return scans with readings of equal bearing adjacent; they share a ray."""
    if scans.scans == 1:
        return _grouped(scans, ray_of)
    return _join([_grouped(scans.part(i, i + 1), ray_of) for i in range(scans.scans)])


def _numbers_of(chosen: np.ndarray) -> np.ndarray:
    """Return the numbers (S,) of chosen readings (S, K); a single scan's takes a tenth of the time of several."""
    return np.array([np.count_nonzero(chosen)]) if len(chosen) == 1 else np.count_nonzero(chosen, axis=1)


def _grouped(scan: ClassedScans, ray_of: np.ndarray) -> ClassedScans:
    """Return a single scan with its readings in the order of their rays, without repetition of rays."""
    vectors, rays = scan.vectors, ray_of.take(scan.columns)
    _, index, inverse, counts = np.unique(rays, return_index=True, return_inverse=True, return_counts=True)
    if len(index) == len(vectors):
        return scan
    # Rays are in the order of their first readings.
    place = np.argsort(index)
    order = np.argsort(np.argsort(place)[inverse], kind="stable")
    return ClassedScans(
        scan.columns[order], scan.readings[order], vectors[order], vectors[index[place]],
        np.append(0, np.cumsum(counts[place])).astype(np.int32), np.array([len(index)]), scan.counts, scan.constants,
        scan.left_out,
    )  # fmt: skip


def _join(scans: Sequence[ClassedScans]) -> ClassedScans:
    """Return several single scans as one object."""
    counts, ray_counts, constants = (
        np.concatenate([getattr(scan, name) for scan in scans]) for name in ("counts", "ray_counts", "constants")
    )
    before = np.cumsum(counts) - counts
    firsts = [scan.ray_offsets[:-1] + begin for scan, begin in zip(scans, before, strict=True)]
    first = np.append(np.concatenate(firsts), counts.sum()).astype(np.int32)
    columns, readings, vectors, rays = (
        np.concatenate([getattr(scan, name) for scan in scans]) for name in ("columns", "readings", "vectors", "rays")
    )
    return ClassedScans(columns, readings, vectors, rays, first, ray_counts, counts, constants, scans[-1].left_out)
