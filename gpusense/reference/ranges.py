"""Expected ranges of poses and bearings by any caster."""

import importlib

import numpy as np

from gpusense.interface.casters import caster_file
from gpusense.reference.crowd import meet_shapes
from gpusense.reference.ray import expected_range
from gpusense.reference.raycast import sectors_of
from gpusense.reference.shapes import DIRECTIONS, particles_of_worlds, world_begin, world_window

BLOCK = 1 << 15


def caster_of(flags):
    """Return the module of the caster of a set of flags."""
    return importlib.import_module(f"gpusense.reference.{caster_file(flags)}")


def cast_in_worlds(flags, map_table, world, pose_cell, pose, ray, window, rays, limit, caster):
    """Return the (N * R,) distances in cells of all rays of some particles, each in its world."""
    cast_ray, count = caster_of(flags).cast_ray, len(pose)
    if "WORLDS" not in flags:
        lanes = (np.repeat(pose_cell, rays, axis=0), np.repeat(pose, rays, axis=0))
        return cast_ray(flags, map_table, window, *lanes, np.tile(ray[:rays], (count, 1)), limit, caster)
    t = np.empty((count, rays), pose.dtype)
    planes = 4 * sectors_of(flags)
    for part in particles_of_worlds(world, count):
        n = int(part[0])
        lanes = (np.repeat(pose_cell[part], rays, axis=0), np.repeat(pose[part], rays, axis=0))
        table, beams = map_table[world_begin(world, n, planes) :], np.tile(ray[:rays], (len(part), 1))
        t[part] = cast_ray(flags, table, world_window(world, n), *lanes, beams, limit, caster).reshape(-1, rays)
    return t.reshape(-1)


def cast_ranges(
    flags, map_table, world, shapes, pose_cell, pose, ray, ranges, window, particles, rays, caster, scale, crowd,
):  # fmt: skip
    """Cast all rays of all particles; see ``meet_shapes``."""
    block = max(BLOCK // max(rays, 1), 1)
    for first in range(0, particles, block):
        part = slice(first, min(first + block, particles))
        own = world[2 * part.start : 2 * part.stop]
        t = cast_in_worlds(flags, map_table, own, pose_cell[part], pose[part], ray, window, rays, scale.limit, caster)
        out = ranges[first * rays : part.stop * rays]
        out[:] = expected_range(flags, np.minimum(t, out) if "SHAPES" in flags else t, scale)


def cast_tiles(
    flags, map_table, world, shapes, pose_cell, pose, order, ray, ranges, window, particles, rays, caster, scale,
    crowd, spread,
):  # fmt: skip
    """Cast all rays of all particles; GPUs do so in tiles of particles and rays."""
    cast_ranges(
        flags, map_table, world, shapes, pose_cell, pose, ray, ranges, window, particles, rays, caster, scale, crowd
    )


def cast_among_shapes(
    flags, map_table, world, shapes, pose_cell, pose, ray, turns, ranges, particles, rays, caster, scale, crowd, each
):  # fmt: skip
    """Cast rays, which ``ray`` has in the order at the end of ``turns``, among moving shapes."""
    meet_shapes(flags, shapes, world, pose_cell, pose, ray, turns, ranges, particles, rays, scale.limit, crowd)
    beams = np.empty_like(ray[:rays])
    beams[turns[DIRECTIONS + 1 : DIRECTIONS + 1 + rays]] = ray[:rays]
    window = world_window(world, 0)
    cast_ranges(
        flags, map_table, world, shapes, pose_cell, pose, beams, ranges, window, particles, rays, caster, scale, crowd
    )
