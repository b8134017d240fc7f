"""Beam model of a whole scan, log p(z | x, m): cast, evaluate the mixture and sum (book table 6.1)."""

from __future__ import annotations

import numpy as np

from gpusense.reference.compat import compat_density
from gpusense.reference.echo import echoes, incidence_terms
from gpusense.reference.error_free import BLOCK_TERMS, add_term
from gpusense.reference.mixture import log_density
from gpusense.reference.ranges import cast_ranges
from gpusense.reference.ray import expected_range
from gpusense.reference.sensor_table import tabulated_density


def score_beams(
    flags: frozenset[str],
    map_table: np.ndarray,
    normals: np.ndarray,
    pose_cell: np.ndarray,
    pose: np.ndarray,
    ray: np.ndarray,
    first: np.ndarray,
    reading: np.ndarray,
    terms: np.ndarray,
    edges: np.ndarray,
    sensor: np.ndarray,
    log_p: np.ndarray,
    parts: np.ndarray,
    rows: int,
    cols: int,
    particles: int,
    rays: int,
    readings: int,
    kinds: int,
    cone_rays: int,
    critical: np.floating,
    bins: int,
    slack: np.floating,
    tolerance: np.floating,
    cells: int,
    per_metre: np.floating,
    limit: np.floating,
    resolution: np.floating,
    range_max: np.floating,
    fixed: np.floating,
    temperature: np.floating,
) -> None:
    """Readings of ray r are first[r] to first[r + 1] - 1; what does not depend on the pose is fixed."""
    real = pose.dtype
    block = max((1 << 20) // max(readings * cone_rays, 1), 1)
    ray_of = np.repeat(np.arange(rays), np.diff(first[: rays + 1]))
    for begin in range(0, particles, block):
        end = min(begin + block, particles)
        own = terms
        if "ECHO" in flags:
            t, cosine, _ = echoes(
                flags, map_table, normals, rows, cols, pose_cell[begin:end], pose[begin:end], ray, rays, cone_rays,
                critical, limit, bins, slack, tolerance,
            )  # fmt: skip
            ranges = expected_range(t, limit, resolution, range_max)
            if "INCIDENCE" in flags:
                own = incidence_terms(terms, edges, kinds, cosine.reshape(end - begin, rays)[:, ray_of])
        else:
            ranges = np.empty((end - begin) * rays, real)
            cast_ranges(
                flags, map_table, pose_cell[begin:end], pose[begin:end], ray, ranges, rows, cols, end - begin, rays,
                bins, slack, tolerance, limit, resolution, range_max,
            )  # fmt: skip
        expected = ranges.reshape(end - begin, rays)[:, ray_of]
        z = np.broadcast_to(reading[:readings], expected.shape)
        if "CUBES" in flags:
            term = compat_density(flags, z, expected, own) ** 3
        elif "SENSOR_TABLE" in flags:
            term = tabulated_density(z, expected, sensor, cells, per_metre, range_max)
        else:
            term = log_density(flags, z, expected, own)
        if "ALL_READINGS" in flags:
            atom = term if "SENSOR_TABLE" in flags else np.where(np.isinf(z), own[7], term)
            term = np.where(np.isnan(z), 0, atom).astype(real)
        if "PER_BEAM" in flags:
            parts[begin * readings : end * readings] = term.ravel()
        log_p[begin:end] = sum_terms(flags, term, fixed, temperature)


def beam_tiles(
    flags: frozenset[str],
    map_table: np.ndarray,
    normals: np.ndarray,
    pose_cell: np.ndarray,
    pose: np.ndarray,
    order: np.ndarray,
    ray: np.ndarray,
    first: np.ndarray,
    reading: np.ndarray,
    terms: np.ndarray,
    edges: np.ndarray,
    sensor: np.ndarray,
    parts: np.ndarray,
    rows: int,
    cols: int,
    particles: int,
    rays: int,
    readings: int,
    kinds: int,
    cone_rays: int,
    critical: np.floating,
    bins: int,
    slack: np.floating,
    tolerance: np.floating,
    cells: int,
    per_metre: np.floating,
    limit: np.floating,
    resolution: np.floating,
    range_max: np.floating,
    across: int,
    along: int,
    spread: int,
) -> None:
    """What each reading adds, at parts[place * across + k * along], which GPUs find in tiles of particles and rays."""
    real, each = pose.dtype.type, np.empty(particles * readings, pose.dtype)
    score_beams(
        flags | {"PER_BEAM"}, map_table, normals, pose_cell, pose, ray, first, reading, terms, edges, sensor,
        np.empty(particles, pose.dtype), each, rows, cols, particles, rays, readings, kinds, cone_rays, critical, bins,
        slack, tolerance, cells, per_metre, limit, resolution, range_max, real(0), real(1),
    )  # fmt: skip
    found = each.reshape(particles, readings)[order[:particles] if "ORDERED" in flags else slice(None)]
    parts[np.arange(particles)[:, None] * across + np.arange(readings) * along] = found


def sum_terms(flags: frozenset[str], term: np.ndarray, fixed: np.floating, temperature: np.floating) -> np.ndarray:
    """Sum of (M, K) terms and a fixed one, in the order of the beams, or its logarithm; -inf where one term is.

    BLOCK_TERMS terms are added plainly, then the block's sum to a compensated total.
    """
    finite = np.where(np.isneginf(term), 0, term).astype(term.dtype)
    total = (np.full(len(term), fixed, term.dtype), np.zeros(len(term), term.dtype))
    for first in range(0, term.shape[1] + 1, BLOCK_TERMS):
        block = np.zeros(len(term), term.dtype)
        for k in range(first, min(first + BLOCK_TERMS, term.shape[1])):
            block += finite[:, k]
        total = add_term(total, block)
    scan = total[0] + total[1]
    scan = np.log(scan) if "CUBES" in flags else scan
    return np.where(np.isneginf(term).any(axis=1), -np.inf, temperature * scan)
