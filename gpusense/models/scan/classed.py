"""Readings of scans on the host: classed, thinned, and grouped by the rays that they share.

Readings are classed first and thinned afterwards, so that ``beams=60`` means 60 informative beams.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from gpusense._util import checks
from gpusense.models.scan.rules import BeamSelection
from gpusense.world.scanner import Scanner, classify_ranges


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
    """The readings of S scans that are evaluated at every pose, one scan after the other.

    Attributes:
        columns: (M,) their positions in their scans, in the order of their rays.
        readings: (M,) ranges in metres; NaN (missing) and inf (max) only where nothing is left out.
        vectors: (M, 2) float64 cosines and sines of their bearings.
        rays: (R, 2) the bearings that are cast.
        ray_offsets: (R + 1,) int32; readings of ray r are ray_offsets[r] to ray_offsets[r + 1] - 1.
        ray_counts: (S,) rays of each scan.
        counts: (S,) readings of each scan.
        constants: (S,) constant terms: log-likelihoods of the readings that do not depend on the pose.
        left_out: The other readings of the last scan.
        scans: S.
        most_readings: Largest number of readings of a scan.
        most_rays: Largest number of rays of a scan.
        shared: Whether several readings share a ray.
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
