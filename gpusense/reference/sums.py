"""Sums of the terms of readings, or of blocks of readings, in the order of the readings."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gpusense.interface import structs
from gpusense.reference.error_free import add_term, strand_sums, strands_in


def sum_parts(flags, parts, order, counts, constant_terms, log_p, particles, count, block, score, batch):
    """Sum ``count`` numbers of each particle, number k at parts[place + k * particles].

    The numbers are sums of blocks or strands (block is 1), or single terms; strands of a block are first added without
    compensation. All are added to a compensated total. Each of several scans has a count, in readings if STRANDED;
    numbers beyond the count are read as 0, which changes no sum.
    """
    places, particle = np.arange(particles), order[:particles] if "ORDERED" in flags else np.arange(particles)
    counted, constant_term = np.full(particles, count), np.full(particles, score.constant_term, parts.dtype)
    if "SCANS" in flags:
        counted, constant_term = counts[particle // batch.per_scan], constant_terms[particle // batch.per_scan]
        counted = strands_in(counted) if "STRANDED" in flags else counted
    total = (constant_term, np.zeros(particles, parts.dtype))
    k = np.arange(count)
    term = np.where(k < counted[:, None], parts[places[:, None] + k * particles], parts.dtype.type(0))
    for part in (term if block == 1 else strand_sums(term)).T:
        total = add_term(total, part)
    scan = total[0] + total[1]
    scan = np.log(scan) if "CUBES" in flags else scan
    log_sum = score.temperature * scan
    if "CUBES" not in flags:
        log_sum = np.where(np.isinf(total[0]), total[0], log_sum)
    log_p[particle] = log_sum


def particles_of_scans(particles: int, batch: structs.ScanBatch) -> Iterator[tuple[int, slice]]:
    """Yield the index of each scan and its particles, of a launch that has a part of all particles.

    ``batch``: particles of each scan, and those of earlier launches.
    """
    begin = 0
    while begin < particles:
        scan = (begin + batch.ahead) // batch.per_scan
        end = min((scan + 1) * batch.per_scan - batch.ahead, particles)
        yield scan, slice(begin, end)
        begin = end
