"""A scan on its way to a device: which readings depend on the pose, which rays they share, what is constant.

Readings are classed first and thinned afterwards, so that ``beams=60`` means 60 informative beams.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gpusense._util.checks import array, as_array, integer, show
from gpusense.world.scanner import Reading, Scanner, classify

Beams = int | Sequence[int] | np.ndarray | None


@dataclass(frozen=True)
class Batch:
    """Where each of S scans has its own among the readings of all.

    Attributes:
        start: (S + 1,) int32; rays of scan s are start[s] to start[s + 1] - 1.
        counts: (S,) int32 readings that are evaluated of each scan.
        constants: (S,) log-likelihoods of the readings that do not depend on the pose.
    """

    start: np.ndarray
    counts: np.ndarray
    constants: np.ndarray

    @property
    def start_readings(self) -> np.ndarray:
        """(S + 1,) int32; readings of scan s are start_readings[s] to start_readings[s + 1] - 1."""
        start = np.zeros(len(self.counts) + 1, np.int32)
        np.cumsum(self.counts, out=start[1:])
        return start


@dataclass(frozen=True)
class PreparedScan:
    """What a launch needs of a scan, or of several one after the other.

    Attributes:
        columns: (M,) positions in the scan of the readings that are evaluated, in the order of their rays.
        readings: (M,) their ranges in metres; NaN (missing) and inf (max) only where nothing is left out.
        vectors: (M, 2) float64 cosine and sine of their bearings.
        rays: (R, 2) the bearings that are cast.
        first: (R + 1,) int32; readings of ray r are first[r] to first[r + 1] - 1.
        constant: Log-likelihood of the readings that do not depend on the pose.
        max_columns: Positions of max readings that are in the constant.
        missing: Missing readings, left out.
        ignored_max: Max readings that say nothing because z_max = 0, left out.
        thinned: Informative readings left out by ``beams=``.
        batch: Where several scans lie; the constant, the positions of max readings and the numbers of those left out
            are then not filled in.
    """

    columns: np.ndarray
    readings: np.ndarray
    vectors: np.ndarray
    rays: np.ndarray
    first: np.ndarray
    constant: float
    max_columns: np.ndarray
    missing: int
    ignored_max: int
    thinned: int
    batch: Batch | None = None

    @property
    def shared(self) -> bool:
        """Whether several readings share a ray."""
        return len(self.rays) < len(self.readings)

    @property
    def most_readings(self) -> int:
        """Readings of the scan, or of the one that has most."""
        return len(self.readings) if self.batch is None else int(self.batch.counts.max(initial=0))

    @property
    def most_rays(self) -> int:
        """Rays of the scan, or of the one that has most."""
        return len(self.rays) if self.batch is None else int(np.diff(self.batch.start).max(initial=0))


def choose_beams(kinds: np.ndarray, beams: Beams, informative_max: bool) -> np.ndarray:
    """Whether each reading is used: all, an even choice of ``beams`` informative ones, or those of given indices."""
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
    """Readings of one scan (K,) or of several (S, K), in their own float dtype."""
    given = as_array("ranges", ranges)
    shape = ("S", scanner.count) if given.ndim == 2 else (scanner.count,)
    return array("ranges", given, shape=shape, finite=False, dtype=None)


def prepare_scan(
    ranges: np.ndarray,
    scanner: Scanner,
    vectors: np.ndarray,
    z_max: float,
    beams: Beams,
    specialize: bool,
    *,
    max_is_range: bool = False,
    max_depends: bool = False,
    distinct: bool = False,
) -> PreparedScan:
    """Class, choose and group the readings of one scan.

    Args:
        ranges: (K,) metres.
        scanner: Its geometry.
        vectors: (K, 2) float64 cosine and sine of the bearings, mount included.
        z_max: Probability of a max reading; 0 makes it missing.
        beams: Which beams are used.
        specialize: False keeps readings without information, and casts equal bearings one by one.
        max_is_range: Evaluate finite max readings like ranges, at range_max.
        max_depends: The probability of a max reading depends on the pose, so such readings are evaluated too.
        distinct: No two bearings are known to be the same.
    """
    if specialize and distinct and beams is None and not (max_is_range or max_depends):
        return _plain_scan(ranges, scanner, vectors, z_max)
    kinds = classify(ranges, scanner)
    if max_is_range:
        kinds[(kinds == Reading.MAX) & np.isfinite(ranges)] = Reading.HIT
        ranges = np.minimum(ranges, scanner.range_max)
    used = choose_beams(kinds, beams, z_max > 0)
    is_max = used & (kinds == Reading.MAX)
    hit = used & (kinds == Reading.HIT)
    informative = int(np.count_nonzero((kinds == Reading.HIT) | ((kinds == Reading.MAX) & (z_max > 0))))
    values = np.where(hit, ranges, np.nan).astype(np.float64)
    values[is_max] = np.inf
    if specialize and not max_depends:
        columns = np.flatnonzero(hit)
        constant = float(np.count_nonzero(is_max) * np.log(z_max)) if is_max.any() else 0.0
    else:
        columns = np.flatnonzero(hit | is_max) if specialize else np.arange(len(kinds))
        constant = 0.0
        is_max = np.zeros_like(is_max)
    rays, first, order = _group(vectors[columns], specialize and not distinct)
    return PreparedScan(
        columns=columns[order],
        readings=values[columns][order],
        vectors=vectors[columns][order],
        rays=rays,
        first=first,
        constant=constant,
        max_columns=np.flatnonzero(is_max),
        missing=int(np.count_nonzero(kinds == Reading.MISSING)),
        ignored_max=0 if z_max > 0 else int(np.count_nonzero(kinds == Reading.MAX)),
        thinned=informative - int(np.count_nonzero(used)),
    )


@functools.lru_cache(maxsize=64)
def _limits(range_min: float, range_max: float, dtype: np.dtype) -> tuple[np.floating, np.floating]:
    """The scanner's limits as readings of a type compare with them."""
    with np.errstate(over="ignore"):
        return dtype.type(range_min), dtype.type(range_max)


def hits_and_max(ranges: np.ndarray, scanner: Scanner) -> tuple[np.ndarray, np.ndarray]:
    """Which readings of scans are ranges, and which are max readings."""
    nearest, farthest = _limits(scanner.range_min, scanner.range_max, ranges.dtype)
    hit: np.ndarray = ranges >= nearest
    if nearest == 0 < scanner.range_min:
        hit &= ranges > 0
    hit &= ranges < farthest
    return hit, ranges >= farthest


def _plain_scan(ranges: np.ndarray, scanner: Scanner, vectors: np.ndarray, z_max: float) -> PreparedScan:
    """``prepare_scan`` where all beams are used and none repeats another: what filters do at every step."""
    hit, is_far = hits_and_max(ranges, scanner)
    columns, count = hit.nonzero()[0], 0
    far = columns[:0]
    if len(columns) < len(ranges):
        far = is_far.nonzero()[0]
        count = len(far)
        ranges, vectors = ranges[columns], vectors[columns]
    return PreparedScan(
        columns=columns,
        readings=ranges.astype(np.float64),
        vectors=vectors,
        rays=vectors,
        first=np.arange(len(columns) + 1, dtype=np.int32),
        constant=float(count * np.log(z_max)) if count and z_max > 0 else 0.0,
        max_columns=far if z_max > 0 else columns[:0],
        missing=scanner.count - len(columns) - count,
        ignored_max=0 if z_max > 0 else count,
        thinned=0,
    )


def _group(vectors: np.ndarray, share: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays without repetition, the readings of each, and the order of readings that makes them neighbours."""
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
