"""Likelihood field of a whole scan (book table 6.3): one look-up at each beam's end point.

A ring of two cells around the table represents everything outside the grid, so no look-up needs a bounds test.
"""

import numpy as np

from gpusense.interface import structs
from gpusense.interface.constants import BLOCK_TERMS
from gpusense.reference.beam import sum_terms
from gpusense.reference.error_free import block_sums
from gpusense.reference.field_term import reading_value
from gpusense.reference.shapes import particles_of_worlds, world_begin, world_window
from gpusense.reference.sums import particles_of_scans

BLOCK = 1 << 18


def score_field(
    flags, table, world, shapes, pose_cell, pose, pose_low, point, point_low, terms, start, constant_terms, log_p,
    parts, window, particles, readings, guard, score, batch, crowd,
):  # fmt: skip
    """Score scans; the table holds log densities, or capped distances in metres where it is interpolated."""
    if "SCANS" in flags:
        for scan, part in particles_of_scans(particles, batch):
            first, last = start[scan], start[scan + 1]
            score_field(
                flags - {"SCANS"}, table, world[2 * part.start :], shapes, pose_cell[part], pose[part], pose_low[part],
                point[first:last], point_low[first:last], terms, start, constant_terms, log_p[part], parts, window,
                part.stop - part.start, int(last - first), guard,
                structs.Score(constant_terms[scan], score.temperature), batch, crowd,
            )  # fmt: skip
        return
    if "WORLDS" in flags:
        for here in particles_of_worlds(world, particles):
            n, own = int(here[0]), np.empty(len(here), log_p.dtype)
            own_parts = np.empty(len(here) * readings if "PER_BEAM" in flags else 0, parts.dtype)
            score_field(
                flags - {"WORLDS"}, table[world_begin(world, n, 1) :], world.reshape(-1, 4)[here].reshape(-1, 2),
                shapes, pose_cell[here], pose[here], pose_low[here] if "TWO_PART_POINTS" in flags else pose_low, point,
                point_low, terms, start, constant_terms, own, own_parts, world_window(world, n), len(here), readings,
                guard, score, batch, crowd,
            )  # fmt: skip
            log_p[here] = own
            if "PER_BEAM" in flags:
                parts[: particles * readings].reshape(particles, readings)[here] = own_parts.reshape(-1, readings)
        return
    block = max(BLOCK // max(readings, 1), 1)
    points = point[None, :readings]
    for begin in range(0, particles, block):
        part = slice(begin, min(begin + block, particles))
        low = pose_low[part, None] if "TWO_PART_POINTS" in flags else pose_low[None, :1]
        term = reading_value(
            flags, table, pose_cell[part, None], pose[part, None], low, points, point_low[None, :readings], terms,
            window, shapes, world[2 * begin : 2 * part.stop], crowd,
        )  # fmt: skip
        if "PER_BEAM" in flags:
            parts[begin * readings : part.stop * readings] = term.ravel()
        log_p[part] = sum_terms(flags, term, score, block_sums)


def field_blocks(
    flags, table, world, shapes, pose_cell, pose, pose_low, point, point_low, terms, guard, start, parts, window,
    particles, readings, spread, batch, crowd,
):  # fmt: skip
    """Write the sums of blocks of readings to parts[n + block * particles]; on GPUs a work-item takes single blocks."""
    if "SCANS" in flags:
        for scan, part in particles_of_scans(particles, batch):
            first, last = start[scan], start[scan + 1]
            blocks, count = -(-int(last - first) // BLOCK_TERMS), part.stop - part.start
            scan_parts = np.empty(count * blocks, pose.dtype)
            field_blocks(
                flags - {"SCANS"}, table, world[2 * part.start :], shapes, pose_cell[part], pose[part], pose_low[part],
                point[first:last], point_low[first:last], terms, guard, start, scan_parts, window, count,
                int(last - first), spread, batch, crowd,
            )  # fmt: skip
            at = np.arange(part.start, part.stop) + np.arange(blocks)[:, None] * particles
            parts[at] = scan_parts.reshape(at.shape)
        return
    real, each = pose.dtype.type, np.empty(particles * readings, pose.dtype)
    score_field(
        flags | {"PER_BEAM"}, table, world, shapes, pose_cell, pose, pose_low, point, point_low, terms, start, guard,
        np.empty(particles, pose.dtype), each, window, particles, readings, real(0), structs.Score(real(0), real(1)),
        batch, crowd,
    )  # fmt: skip
    each = each.reshape(particles, readings)
    sums = block_sums(each)
    parts[np.arange(particles)[:, None] + np.arange(sums.shape[1]) * particles] = sums
