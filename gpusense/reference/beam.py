"""Beam model of a whole scan, log p(z | x, m): cast, evaluate the mixture and sum (book table 6.1)."""

import numpy as np

from gpusense.interface import structs
from gpusense.reference.crowd import meet_shapes
from gpusense.reference.echo import echoes, incidence_terms
from gpusense.reference.error_free import add_term, strand_sums, strands_in
from gpusense.reference.mixture import compat_density, last_range, log_density
from gpusense.reference.ranges import cast_ranges
from gpusense.reference.ray import expected_range
from gpusense.reference.sensor_table import tabulated_density
from gpusense.reference.shapes import DIRECTIONS
from gpusense.reference.sums import particles_of_scans


def ray_limit(flags, z, terms, scale):
    """Return the distances in cells to which the rays of readings are cast."""
    if "STOPS" not in flags:
        return np.full_like(z, scale.limit)
    return np.fmin(last_range(z, terms) / scale.resolution, scale.limit)


def cast_beam(flags, map_table, normals, pose_cell, pose, ray, rays, window, cone, caster, scale, shapes, world, crowd):
    """Return the (N * R,) expected ranges of rays or cones [m], and the cosines of incidence of cones; none of rays."""
    if "CONES" in flags:
        t, cosine, _ = echoes(
            flags, map_table, normals, window, pose_cell, pose, ray, rays, cone, scale.limit, caster, shapes, world,
            crowd,
        )  # fmt: skip
        return expected_range(flags, t, scale), cosine
    ranges = np.empty(len(pose) * rays, pose.dtype)
    if "SHAPES" in flags:
        turns = np.r_[np.zeros(DIRECTIONS + 1, int), :rays]
        meet_shapes(
            flags, shapes, world, pose_cell, pose, ray, turns, ranges, len(pose), rays, scale.limit, crowd
        )  # fmt: skip
    cast_ranges(
        flags, map_table, world, shapes, pose_cell, pose, ray, ranges, window, len(pose), rays, caster, scale, crowd
    )
    return ranges, np.empty(0, pose.dtype)


def reading_term(flags, z, expected, terms, sensor, tables, range_max):
    """Return the terms of the scan's sum: log densities of readings, or cubes of densities."""
    if "CUBES" in flags:
        term = compat_density(flags, z, expected, terms) ** 3
    elif "SENSOR_TABLE" in flags:
        term = tabulated_density(z, expected, sensor, tables, range_max)
    else:
        term = log_density(flags, z, expected, terms)
    if "ALL_READINGS" in flags:
        # 3: failure, an atom at the longest range.
        atom = term if "SENSOR_TABLE" in flags else np.where(np.isinf(z), terms.z_max, term)
        term = np.where(np.isnan(z), 0, atom).astype(expected.dtype)
    return term


def scan_log(flags, total):
    """Return the scan's logarithm from its sum."""
    return np.log(total) if "CUBES" in flags else total


def readings_of_scan(flags, scan, start, first, reading):
    """Return one of several scans: its first ray, its number of rays, the first reading of each ray, its readings."""
    begin, rays = int(start[scan]), int(start[scan + 1] - start[scan])
    if "SHARED_RAYS" not in flags:
        return begin, rays, np.arange(rays + 1), reading[begin:]
    scan_first = first[begin : begin + rays + 1]
    return begin, rays, scan_first - scan_first[0], reading[scan_first[0] :]


def score_beams(
    flags, map_table, world, shapes, normals, pose_cell, pose, ray, first, reading, terms, masses, edges, sensor,
    start, constant_terms, log_p, parts, window, particles, rays, readings, tables, cone, caster, scale, crowd,
    score, batch,
):  # fmt: skip
    """Score scans; ray r has the readings first[r] to first[r + 1] - 1, and ``score`` has the constant term.

    SCANS: the rays of a scan begin at start[scan]; where rays are shared, first counts the readings of all scans.
    """
    if "SCANS" in flags:
        for scan, part in particles_of_scans(particles, batch):
            begin, scan_rays, scan_first, scan_reading = readings_of_scan(flags, scan, start, first, reading)
            score_beams(
                flags - {"SCANS"}, map_table, world[2 * part.start :], shapes, normals, pose_cell[part], pose[part],
                ray[begin * cone.rays :], scan_first, scan_reading, terms, masses, edges, sensor, start, constant_terms,
                log_p[part], parts, window, part.stop - part.start, scan_rays, int(scan_first[scan_rays]), tables,
                cone, caster, scale, crowd, structs.Score(constant_terms[scan], score.temperature), batch,
            )  # fmt: skip
        return
    block = max((1 << 20) // max(readings * cone.rays, 1), 1)
    ray_of = np.arange(rays)
    if "SHARED_RAYS" in flags:
        ray_of = np.repeat(ray_of, np.diff(first[: rays + 1]))
    for begin in range(0, particles, block):
        end = min(begin + block, particles)
        part, bin_terms = slice(begin, end), terms
        ranges, cosine = cast_beam(
            flags, map_table, normals, pose_cell[part], pose[part], ray, rays, window, cone, caster, scale, shapes,
            world[2 * begin : 2 * end], crowd,
        )  # fmt: skip
        if "INCIDENCE" in flags:
            bin_terms = incidence_terms(terms, edges, tables.incidence_bins, cosine.reshape(-1, rays)[:, ray_of])
        expected = ranges.reshape(end - begin, rays)[:, ray_of]
        z = np.broadcast_to(reading[:readings], expected.shape)
        # Devices cast rays up to their limits only; here ranges are cut there.
        limit = ray_limit(flags, z, terms, scale)
        expected = np.where(limit < scale.limit, np.fmin(expected, limit * scale.resolution), expected)
        term = reading_term(flags, z, expected, bin_terms, sensor, tables, scale.range_max)
        if "PER_BEAM" in flags:
            parts[begin * readings : end * readings] = term.ravel()
        log_p[part] = sum_terms(flags, term, score, strand_sums)


def beam_tiles(
    flags, map_table, world, shapes, normals, pose_cell, pose, order, ray, first, reading, terms, masses, edges,
    sensor, start, parts, window, particles, rays, readings, tables, cone, caster, scale, crowd, spread, batch,
):  # fmt: skip
    """Write the term of reading k to parts[place + k * particles]; GPUs do so in tiles of particles and rays.

    STRANDED: the number at place k is the sum of strand k.
    """
    places = np.arange(particles)
    if "ORDERED" in flags:
        places[order[:particles]] = np.arange(particles)
    if "SCANS" in flags:
        for scan, part in particles_of_scans(particles, batch):
            begin, scan_rays, scan_first, scan_reading = readings_of_scan(flags, scan, start, first, reading)
            each = int(scan_first[scan_rays])
            each = strands_in(each) if "STRANDED" in flags else each
            scan_parts = np.empty((part.stop - part.start) * each, pose.dtype)
            beam_tiles(
                flags - {"SCANS", "ORDERED"}, map_table, world[2 * part.start :], shapes, normals, pose_cell[part],
                pose[part], order, ray[begin * cone.rays :], scan_first, scan_reading, terms, masses, edges, sensor,
                start, scan_parts, window, part.stop - part.start, scan_rays, int(scan_first[scan_rays]), tables, cone,
                caster, scale, crowd, spread, batch,
            )  # fmt: skip
            at = places[part] + np.arange(each)[:, None] * particles
            parts[at] = scan_parts.reshape(at.shape)
        return
    real, single = pose.dtype.type, np.empty(particles * readings, pose.dtype)
    score_beams(
        flags | {"PER_BEAM"}, map_table, world, shapes, normals, pose_cell, pose, ray, first, reading, terms, masses,
        edges, sensor, start, sensor, np.empty(particles, pose.dtype), single, window, particles, rays, readings,
        tables, cone, caster, scale, crowd, structs.Score(real(0), real(1)), batch,
    )  # fmt: skip
    term = single.reshape(particles, readings)
    term = strand_sums(term) if "STRANDED" in flags else term
    parts[places[:, None] + np.arange(term.shape[1]) * particles] = term


def sum_terms(flags, term, score, plainly):
    """Sum (M, K) terms and a constant term in the order of the beams; -inf where any term is -inf.

    ``plainly`` is block_sums or strand_sums; their results are added to a compensated total.
    """
    finite = np.where(np.isneginf(term), 0, term).astype(term.dtype)
    total = (np.full(len(term), score.constant_term, term.dtype), np.zeros(len(term), term.dtype))
    for part in plainly(finite).T:
        total = add_term(total, part)
    return np.where(np.isneginf(term).any(axis=1), -np.inf, score.temperature * scan_log(flags, total[0] + total[1]))
