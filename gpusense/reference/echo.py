"""The nearest return among the rays of a sensor's cone (one ray for a laser), and its angle of incidence.

The angle of incidence lies between the ray and the normal of the surface that it hits. The table of normals has a ring
of cells around the map. It holds 0 for free cells and NaN for occupied cells without a normal, at which the cosine
counts as 1.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface import structs
from gpusense.reference.ranges import BLOCK, caster_of
from gpusense.reference.ray import crossed, expected_range, make_ray, off_grid
from gpusense.reference.raycast import sectors_of
from gpusense.reference.shapes import nearest_shape, particles_of_worlds, world_begin, world_window


def is_wall(normal: np.ndarray) -> np.ndarray:
    """Return whether (M, 2) normals belong to obstacles."""
    return (normal != 0).any(axis=1)


def normal_at(flags, normals, window, col, row):
    """Return (M, 2) normals of cells."""
    beyond = off_grid(np.stack([col + 1, row + 1]), window.rows + 2, window.cols + 2)
    normal = normals[np.where(beyond, 0, (row + 1) * (window.cols + 2) + col + 1)]
    normal[beyond] = np.nan if "OUTSIDE_OCCUPIED" in flags else 0
    return normal


def hit_normal(flags, normals, window, cell, r, t):
    """Return the normals of the cells in which M rays end at distances t.

    The distance determines the cell of the exact walk: it has crossed all boundaries in x up to t, and all boundaries
    in y before t, or up to t after a step in y. At a corner it steps in x first.
    """
    x, y = cell.T.astype(np.int64)
    col = x + r.step[0] * crossed(t, r.speed[0], r.a[0], r.inv[0], True).astype(np.int64)
    before, until = (
        y + r.step[1] * crossed(t, r.speed[1], r.a[1], r.inv[1], upto).astype(np.int64) for upto in (False, True)
    )
    start_normal, first, second = (
        normal_at(flags, normals, window, *at) for at in ((x, y), (col, before), (col, until))
    )
    later = np.where(is_wall(first)[:, None], first, second)
    return np.where(((t == 0) & is_wall(start_normal))[:, None], start_normal, later)


def incidence_terms(
    terms: structs.MixtureTerms, edges: np.ndarray, incidence_bins: int, cosine: np.ndarray
) -> structs.MixtureTerms:
    """Return the terms of the mixture for angles of incidence; edges are cosines of the bins' upper ends."""
    bins = (cosine[..., None] <= edges[: incidence_bins - 1]).sum(axis=-1)
    return structs.MixtureTerms(*(np.asarray(column)[bins] for column in terms))


def nearest_echo(flags, map_table, normals, window, cell, pose, ray, critical, limit, caster, shapes, world, crowd):
    """Return the nearest returns of M cones: distances in cells, and cosines and sines of angles of incidence.

    Arguments are as for ``dda.cast_ray``; ``ray``: (M, C, 2) rays of each cone; ``world``: (2 M, 2) numbers of the
    cones' worlds, not read without SHAPES. Beyond the critical angle a surface reflects a ray like a mirror. A beam
    without a return gets limit, 2 and 0: 2 exceeds every cosine, so that the first bin can hold such beams alone.
    """
    real = pose.dtype.type
    nearest = np.full(len(cell), limit, pose.dtype)
    cosine, sine = np.full_like(nearest, 2), np.zeros_like(nearest)
    for i in range(ray.shape[1]):
        met = t = caster_of(flags).cast_ray(flags, map_table, window, cell, pose, ray[:, i], limit, caster)
        if "SHAPES" in flags:
            t, shape_cosine = nearest_shape(shapes, world, crowd, cell, pose, ray[:, i], met)
        heard = t < nearest
        if "INCIDENCE" in flags:
            r = make_ray(pose, ray[:, i])
            normal = hit_normal(flags, normals, window, cell, r, t)
            known, (dx, dy) = ~np.isnan(normal[:, 0]), r.direction
            straight = np.where(known, np.abs(dx * normal[:, 0] + dy * normal[:, 1]), real(1))
            aslant = np.where(known, np.abs(dx * normal[:, 1] - dy * normal[:, 0]), real(0))
            if "SHAPES" in flags:
                straight = np.where(t < met, shape_cosine, straight)
                aslant = np.where(t < met, np.sqrt(np.maximum((1 - straight) * (1 + straight), 0)), aslant)
            heard &= straight >= critical
            cosine[heard], sine[heard] = straight[heard], aslant[heard]
        nearest[heard] = t[heard]
    return nearest, cosine, sine


def cast_echoes(
    flags, map_table, world, shapes, normals, pose_cell, pose, ray, ranges, incidence, window, particles, rays,
    cone, caster, scale, crowd,
):  # fmt: skip
    """Cast the cones of all particles to expected ranges and angles of incidence, NaN without a return.

    With COSINES, cosines replace the angles; 2 without a return.
    """
    block = max(BLOCK // max(rays, 1), 1)
    for first in range(0, particles, block):
        part = slice(first, min(first + block, particles))
        entries = slice(part.start * rays, part.stop * rays)
        t, cosine, sine = echoes(
            flags, map_table, normals, window, pose_cell[part], pose[part], ray, rays, cone, scale.limit, caster,
            shapes, world[2 * part.start : 2 * part.stop], crowd,
        )  # fmt: skip
        ranges[entries] = expected_range(flags, t, scale)
        if "INCIDENCE" in flags:
            angle = np.where(t < scale.limit, np.arctan2(sine, cosine), np.nan)
            incidence[entries] = cosine if "COSINES" in flags else angle


def echoes(flags, map_table, normals, window, cell, pose, ray, rays, cone, limit, caster, shapes, world, crowd):
    """Return ``nearest_echo`` of all cones at all poses, (N * rays,) each."""
    if "WORLDS" in flags:
        found = np.empty((3, len(pose), rays), pose.dtype)
        for part in particles_of_worlds(world, len(pose)):
            n = int(part[0])
            found[:, part] = np.stack(echoes(
                flags - {"WORLDS"}, map_table[world_begin(world, n, 4 * sectors_of(flags)) :],
                normals[world_begin(world, n, 1) :], world_window(world, n), cell[part], pose[part], ray, rays, cone,
                limit, caster, shapes, world.reshape(-1, 4)[part].reshape(-1, 2), crowd,
            )).reshape(3, len(part), rays)  # fmt: skip
        t, cosine, sine = found.reshape(3, -1)
        return t, cosine, sine
    of_rays = np.repeat(world.reshape(-1, 4), rays, axis=0).reshape(-1, 2) if "SHAPES" in flags else world
    lanes = (np.repeat(cell, rays, axis=0), np.repeat(pose, rays, axis=0))
    cones = np.tile(ray[: rays * cone.rays].reshape(rays, cone.rays, 2), (len(pose), 1, 1))
    return nearest_echo(
        flags, map_table, normals, window, *lanes, cones, cone.critical, limit, caster, shapes, of_rays, crowd
    )
