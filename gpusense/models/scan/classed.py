"""Readings of scans on the host: classed, thinned, and grouped by the rays that they share.

Readings are classed first and thinned afterwards, so that ``beams=60`` means 60 informative beams.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from gpusense._util.checks import array, as_array, integer, show
from gpusense.world.scanner import Reading, Scanner, classify

Beams = int | Sequence[int] | np.ndarray | None
_NONE = np.zeros(0, np.intp)


@dataclass(frozen=True)
class Rules:
    """Rules by which readings are classed, thinned and grouped.

    Attributes:
        scanner: The scanner's geometry.
        vectors: (K, 2) float64 cosines and sines of the bearings, the mount's yaw included.
        z_max: Probability of a max reading; 0 makes it missing.
        beams: The beams that are used.
        specialize: False keeps readings without information, and casts equal bearings one by one.
        max_is_range: Evaluate finite max readings like ranges, at range_max.
        max_depends: The probability of a max reading depends on the pose, so such readings are evaluated.
    """

    scanner: Scanner
    vectors: np.ndarray
    z_max: float
    beams: Beams
    specialize: bool
    max_is_range: bool = False
    max_depends: bool = False

    @functools.cached_property
    def distinct(self) -> bool:
        """Whether no two bearings are the same."""
        return len(np.unique(self.vectors, axis=0)) == len(self.vectors)

    @functools.cached_property
    def plain(self) -> bool:
        """Whether each range is evaluated on a separate ray, and max readings are constant."""
        return self.specialize and self.distinct and not (self.max_is_range or self.max_depends)


@dataclass(frozen=True)
class LeftOut:
    """Readings of a scan that are not evaluated at every pose.

    Attributes:
        missing: Missing readings.
        ignored_max: Max readings without information because z_max = 0.
        constant_max: (C,) positions of the max readings in the constant term.
        thinned: Informative readings left out by ``beams=``.
    """

    missing: int
    ignored_max: int
    constant_max: np.ndarray
    thinned: int


@dataclass(frozen=True)
class ClassedScans:
    """The readings of S scans that are evaluated at every pose, one scan after the other.

    Attributes:
        columns: (M,) their positions in their scans, in the order of their rays.
        readings: (M,) ranges in metres; NaN (missing) and inf (max) only where nothing is left out.
        vectors: (M, 2) float64 cosines and sines of their bearings.
        rays: (R, 2) the bearings that are cast.
        first: (R + 1,) int32; readings of ray r are first[r] to first[r + 1] - 1.
        ray_counts: (S,) rays of each scan.
        counts: (S,) readings of each scan.
        constants: (S,) constant terms: log-likelihoods of the readings that do not depend on the pose.
        left_out: The other readings of the last scan.
    """

    columns: np.ndarray
    readings: np.ndarray
    vectors: np.ndarray
    rays: np.ndarray
    first: np.ndarray
    ray_counts: np.ndarray
    counts: np.ndarray
    constants: np.ndarray
    left_out: LeftOut

    @property
    def scans(self) -> int:
        """S."""
        return len(self.counts)

    @property
    def shared(self) -> bool:
        """Whether several readings share a ray."""
        return len(self.rays) < len(self.readings)

    @functools.cached_property
    def most_readings(self) -> int:
        """Readings of the scan that has most."""
        return int(np.maximum.reduce(self.counts))

    @functools.cached_property
    def most_rays(self) -> int:
        """Rays of the scan that has most."""
        return self.most_readings if self.ray_counts is self.counts else int(np.maximum.reduce(self.ray_counts))

    def part(self, begin: int, end: int) -> ClassedScans:
        """Return scans ``begin`` to ``end`` - 1."""
        if (begin, end) == (0, self.scans):
            return self
        rays = slice(int(self.ray_counts[:begin].sum()), int(self.ray_counts[:end].sum()))
        first = self.first[rays.start : rays.stop + 1]
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


def choose_beams(kinds: np.ndarray, beams: Beams, informative_max: bool) -> np.ndarray:
    """Return whether each reading is used: all, an even choice of ``beams`` informative ones, or those of indices."""
    informative = (kinds == Reading.HIT) | ((kinds == Reading.MAX) & informative_max)
    if beams is None:
        return informative
    if isinstance(beams, (int, np.integer)):
        places = np.flatnonzero(informative)
        if len(places) <= beams:
            return informative
        chosen = np.zeros(len(kinds), bool)
        chosen[places[(np.arange(beams) * len(places)) // max(int(beams), 1)]] = True
        return chosen
    chosen = np.zeros(len(kinds), bool)
    chosen[np.asarray(beams, dtype=np.intp)] = True
    return chosen & informative


def check_beams(beams: Beams, count: int) -> Beams:
    """Validate ``beams=`` for a scanner of ``count`` beams.

    Raises:
        ValueError: a number below 0, or an index outside the scan.
        TypeError: not an integer or a list of them.
    """
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


def check_ranges(ranges: object, scanner: Scanner) -> np.ndarray:
    """Return readings of one scan (K,) or of several (S, K), checked, in their float dtype."""
    readings = as_array("ranges", ranges)
    shape = ("S", scanner.count) if readings.ndim == 2 else (scanner.count,)
    return array("ranges", readings, shape=shape, finite=False, dtype=None)


def class_scans(ranges: np.ndarray, rules: Rules) -> ClassedScans:
    """Class, choose and group the readings of (S, K) scans, S > 0."""
    if rules.plain:
        return _plain_scans(ranges, rules)
    each = [_class_scan(one, rules) for one in ranges]
    return each[0] if len(each) == 1 else _join(each)


def _class_scan(ranges: np.ndarray, rules: Rules) -> ClassedScans:
    """Class, choose and group the readings of one scan."""
    z_max, specialize, kinds = rules.z_max, rules.specialize, classify(ranges, rules.scanner)
    if rules.max_is_range:
        kinds[(kinds == Reading.MAX) & np.isfinite(ranges)] = Reading.HIT
        ranges = np.minimum(ranges, rules.scanner.range_max)
    used = choose_beams(kinds, rules.beams, z_max > 0)
    is_max = used & (kinds == Reading.MAX)
    hit = used & (kinds == Reading.HIT)
    informative = int(np.count_nonzero((kinds == Reading.HIT) | ((kinds == Reading.MAX) & (z_max > 0))))
    values = np.where(hit, ranges, np.nan).astype(np.float64)
    values[is_max] = np.inf
    constant = 0.0
    if specialize and not rules.max_depends:
        columns = np.flatnonzero(hit)
        constant = float(np.count_nonzero(is_max) * np.log(z_max)) if is_max.any() else 0.0
    else:
        columns = np.flatnonzero(hit | is_max) if specialize else np.arange(len(kinds))
        is_max = np.zeros_like(is_max)
    rays, first, order = _group(rules.vectors[columns], specialize and not rules.distinct)
    left_out = LeftOut(
        missing=int(np.count_nonzero(kinds == Reading.MISSING)),
        ignored_max=0 if z_max > 0 else int(np.count_nonzero(kinds == Reading.MAX)),
        constant_max=np.flatnonzero(is_max),
        thinned=informative - int(np.count_nonzero(used)),
    )
    return ClassedScans(
        columns[order], values[columns][order], rules.vectors[columns][order], rays, first, np.array([len(rays)]),
        np.array([len(columns)]), np.array([constant]), left_out,
    )  # fmt: skip


def _join(scans: Sequence[ClassedScans]) -> ClassedScans:
    """Return several single scans as one object."""
    counts, ray_counts, constants = (
        np.concatenate([getattr(scan, name) for scan in scans]) for name in ("counts", "ray_counts", "constants")
    )
    before = np.cumsum(counts) - counts
    firsts = [scan.first[:-1] + begin for scan, begin in zip(scans, before, strict=True)]
    first = np.append(np.concatenate(firsts), counts.sum()).astype(np.int32)
    columns, readings, vectors, rays = (
        np.concatenate([getattr(scan, name) for scan in scans]) for name in ("columns", "readings", "vectors", "rays")
    )
    return ClassedScans(columns, readings, vectors, rays, first, ray_counts, counts, constants, scans[-1].left_out)


@functools.lru_cache(maxsize=64)
def _limits(range_min: float, range_max: float, dtype: np.dtype) -> tuple[np.floating, np.floating]:
    """Return the scanner's limits, rounded to the type of the readings."""
    with np.errstate(over="ignore"):
        return dtype.type(range_min), dtype.type(range_max)


def hits_and_max(ranges: np.ndarray, scanner: Scanner) -> tuple[np.ndarray, np.ndarray]:
    """Return which readings of scans are ranges, and which are max readings."""
    nearest, farthest = _limits(scanner.range_min, scanner.range_max, ranges.dtype)
    hit: np.ndarray = ranges >= nearest
    if nearest == 0 < scanner.range_min:
        hit &= ranges > 0
    hit &= ranges < farthest
    return hit, ranges >= farthest


def _plain_scans(ranges: np.ndarray, rules: Rules) -> ClassedScans:
    """Class scans whose ranges have a ray each: the common case of filters, all scans at once."""
    if rules.beams is None:
        hit, far = hits_and_max(ranges, rules.scanner)
        return _with_ranges(ranges, hit, far, rules)
    kinds = classify(ranges, rules.scanner)
    used = np.array([choose_beams(each, rules.beams, rules.z_max > 0) for each in kinds])
    hit, far = used & (kinds == Reading.HIT), used & (kinds == Reading.MAX)
    return _with_ranges(ranges, hit, far, rules, kinds[-1])


def _with_ranges(
    ranges: np.ndarray, hit: np.ndarray, far: np.ndarray, rules: Rules, kinds: np.ndarray | None = None
) -> ClassedScans:
    """Return scans of the readings that are ranges; max readings add to the constant terms.

    Args:
        ranges: (S, K) metres.
        hit: (S, K) whether a reading is a range that is used.
        far: (S, K) whether it is a max reading that is used.
        rules: The rules for readings.
        kinds: (K,) classes of the last scan's readings where beams are chosen, else None.
    """
    beams, z_max = rules.scanner.count, rules.z_max
    columns, counts = hit.nonzero()[1], np.add.reduce(hit, axis=1)
    constants = np.zeros(len(ranges))
    ignored = constant_max = _NONE
    if len(columns) < ranges.size:
        last = far[-1].nonzero()[0]
        constant_max, ignored = (last, ignored) if z_max > 0 else (ignored, last)
        if z_max > 0:
            far_counts = np.add.reduce(far, axis=1)
            # No max readings add 0, not -0.
            constants = np.where(far_counts > 0, far_counts * np.log(z_max), 0.0)
        values, vectors = ranges[hit].astype(np.float64), rules.vectors[columns]
    else:
        # Scans without gaps need no selection.
        values = ranges.reshape(-1).astype(np.float64)
        vectors = rules.vectors if len(ranges) == 1 else rules.vectors[columns]
    kept = int(counts[-1]) + len(constant_max)
    if kinds is None:
        missing, ignored_max, thinned = beams - kept - len(ignored), len(ignored), 0
    else:
        missing = int(np.count_nonzero(kinds == Reading.MISSING))
        ignored_max = 0 if z_max > 0 else int(np.count_nonzero(kinds == Reading.MAX))
        thinned = beams - missing - ignored_max - kept
    first = np.arange(len(columns) + 1, dtype=np.int32)
    left_out = LeftOut(missing, ignored_max, constant_max, thinned)
    return ClassedScans(columns, values, vectors, vectors, first, counts, counts, constants, left_out)


def _group(vectors: np.ndarray, share: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rays without repetition, the first reading of each, and the order of readings that groups them by ray."""
    count = len(vectors)
    plain = (vectors, np.arange(count + 1, dtype=np.int32), np.arange(count))
    if not share or count < 2:
        return plain
    rays, index, inverse = np.unique(vectors, axis=0, return_index=True, return_inverse=True)
    if len(rays) == count:
        return plain
    rank = np.argsort(np.argsort(index))
    ray_of = rank[inverse.ravel()]
    order = np.argsort(ray_of, kind="stable")
    first = np.concatenate([[0], np.cumsum(np.bincount(ray_of, minlength=len(rays)))]).astype(np.int32)
    return vectors[np.sort(index)], first, order
