"""Several scans of one launch; the particles of each scan are contiguous."""

from __future__ import annotations

from collections.abc import Iterator

from gpusense.interface import structs


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
