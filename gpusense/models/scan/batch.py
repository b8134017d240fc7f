"""Several scans on their way to a device as one: their readings one after the other, and where each begins."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from gpusense.models.scan.readings import Batch, Beams, PreparedScan, choose_beams, hits_and_max, prepare_scan
from gpusense.world.scanner import Reading, Scanner, classify

_NOWHERE = np.zeros(0, np.intp)


def prepare_batch(
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
    """Class, choose and group the readings of (S, K) scans, each as ``prepare_scan`` does it."""
    if not (specialize and distinct) or max_is_range or max_depends:
        each = [
            prepare_scan(
                one, scanner, vectors, z_max, beams, specialize,
                max_is_range=max_is_range, max_depends=max_depends, distinct=distinct,
            )
            for one in ranges
        ]  # fmt: skip
        return join(each)
    if beams is None:
        hit, far = hits_and_max(ranges, scanner)
    else:
        kinds = classify(ranges, scanner)
        used = np.array([choose_beams(each, beams, z_max > 0) for each in kinds]).reshape(kinds.shape)
        hit, far = used & (kinds == Reading.HIT), used & (kinds == Reading.MAX)
    far_counts = np.count_nonzero(far, axis=1) if z_max > 0 else np.zeros(len(ranges), int)
    columns, own_counts = hit.nonzero()[1], np.count_nonzero(hit, axis=1)
    constants = np.where(far_counts > 0, far_counts * np.log(z_max if z_max > 0 else 1.0), 0.0)
    own = vectors[columns]
    first = np.arange(len(columns) + 1, dtype=np.int32)
    return _batch(columns, ranges[hit].astype(np.float64), own, own, first, own_counts, own_counts, constants)


def join(scans: Sequence[PreparedScan]) -> PreparedScan:
    """Prepared scans, at least one, as one."""
    rays = np.array([len(scan.rays) for scan in scans])
    counts = np.array([len(scan.readings) for scan in scans])
    before = np.cumsum(counts) - counts
    firsts = [scan.first[:-1] + begin for scan, begin in zip(scans, before, strict=True)]
    first = np.append(np.concatenate(firsts), counts.sum()).astype(np.int32)
    columns, readings, vectors, ray_vectors = (
        np.concatenate([getattr(scan, name) for scan in scans]) for name in ("columns", "readings", "vectors", "rays")
    )
    constants = np.array([scan.constant for scan in scans])
    return _batch(columns, readings, vectors, ray_vectors, first, rays, counts, constants)


def part_of(scan: PreparedScan, begin: int, end: int) -> PreparedScan:
    """Scans begin to end - 1 of a batch."""
    batch = scan.batch
    assert batch is not None
    if (begin, end) == (0, len(batch.counts)):
        return scan
    rays = slice(batch.start[begin], batch.start[end])
    first = scan.first[rays.start : rays.stop + 1]
    own = slice(first[0], first[-1])
    return _batch(
        scan.columns[own], scan.readings[own], scan.vectors[own], scan.rays[rays], first - first[0],
        np.diff(batch.start[begin : end + 1]), batch.counts[begin:end], batch.constants[begin:end],
    )  # fmt: skip


def _batch(
    columns: np.ndarray,
    readings: np.ndarray,
    vectors: np.ndarray,
    rays: np.ndarray,
    first: np.ndarray,
    ray_counts: np.ndarray,
    counts: np.ndarray,
    constants: np.ndarray,
) -> PreparedScan:
    start = np.zeros(len(ray_counts) + 1, np.int32)
    np.cumsum(ray_counts, out=start[1:])
    return PreparedScan(
        columns=columns,
        readings=readings,
        vectors=vectors,
        rays=rays,
        first=first,
        constant=0.0,
        max_columns=_NOWHERE,
        missing=0,
        ignored_max=0,
        thinned=0,
        batch=Batch(start, counts.astype(np.int32), constants),
    )


def runs(scan: PreparedScan, most: int) -> Iterator[tuple[int, int]]:
    """Neighbouring scans of a batch that are scored by the same code, at most so many; in their order.

    That are scans with shared rays, or without; scans of which nothing is evaluated come one by one.
    """
    assert scan.batch is not None
    counts = scan.batch.counts
    kinds = np.where(counts == 0, 0, np.where(counts == np.diff(scan.batch.start), 1, 2))
    begin = 0
    while begin < len(kinds):
        longest = most if kinds[begin] else 1
        others = np.flatnonzero(kinds[begin : begin + longest] != kinds[begin])
        end = begin + int(others[0]) if len(others) else min(begin + longest, len(kinds))
        yield begin, end
        begin = end
