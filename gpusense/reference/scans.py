"""Several scans of one launch; the particles of each scan are contiguous."""

from __future__ import annotations

from collections.abc import Iterator


def particles_of_scans(particles: int, per_scan: int, ahead: int = 0) -> Iterator[tuple[int, slice]]:
    """Yield the index of each scan and its particles, of a launch that has a part of all particles.

    Args:
        particles: Particles of the launch.
        per_scan: Particles of each scan.
        ahead: Particles of the scans that come before those of the launch.
    """
    begin = 0
    while begin < particles:
        scan = (begin + ahead) // per_scan
        end = min((scan + 1) * per_scan - ahead, particles)
        yield scan, slice(begin, end)
        begin = end
