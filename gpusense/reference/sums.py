"""Sums of what single readings, or blocks of them, add to a scan's logarithm, in the order of the readings."""

from __future__ import annotations

import numpy as np

from gpusense.reference.error_free import add_term


def sum_parts(
    flags: frozenset[str],
    parts: np.ndarray,
    order: np.ndarray,
    counts: np.ndarray,
    fixed_of: np.ndarray,
    log_p: np.ndarray,
    particles: int,
    count: int,
    block: int,
    across: int,
    along: int,
    fixed: np.floating,
    temperature: np.floating,
    per_scan: int,
) -> None:
    """Of each particle count numbers, each along farther than the last, from parts[place * across] on.

    A block of them is added plainly, then its sum to a compensated total. Of several scans each has a count of its own;
    what lies beyond it counts as 0, which changes no sum.
    """
    places, own = np.arange(particles) * across, order[:particles] if "ORDERED" in flags else np.arange(particles)
    counted, lead = np.full(particles, count), np.full(particles, fixed, parts.dtype)
    if "SCANS" in flags:
        counted, lead = counts[own // per_scan], fixed_of[own // per_scan]
    total = (lead, np.zeros(particles, parts.dtype))
    for first in range(0, count, block):
        part = np.zeros(particles, parts.dtype)
        for k in range(first, min(first + block, count)):
            part += np.where(k < counted, parts[places + k * along], 0)
        total = add_term(total, part)
    scan = total[0] + total[1]
    scan = np.log(scan) if "CUBES" in flags else scan
    found = temperature * scan
    if "CUBES" not in flags:
        found = np.where(np.isinf(total[0]), total[0], found)
    log_p[own] = found
