"""Expected ranges of poses and bearings by any caster."""

from __future__ import annotations

import importlib
from types import ModuleType

import numpy as np

from gpusense.interface import structs
from gpusense.interface.casters import caster_file
from gpusense.reference.ray import expected_range

BLOCK = 1 << 15


def caster_of(flags: frozenset[str]) -> ModuleType:
    """Return the module of the caster of a set of flags."""
    return importlib.import_module(f"gpusense.reference.{caster_file(flags)}")


def cast_ranges(
    flags: frozenset[str], map_table: np.ndarray, pose_cell: np.ndarray, pose: np.ndarray, ray: np.ndarray,
    ranges: np.ndarray, window: structs.Window, particles: int, rays: int, caster: structs.Caster,
    scale: structs.RangeScale,
) -> None:  # fmt: skip
    """Cast all rays of all particles."""
    cast_ray = caster_of(flags).cast_ray
    block = max(BLOCK // max(rays, 1), 1)
    for first in range(0, particles, block):
        part = slice(first, min(first + block, particles))
        count = part.stop - first
        lanes = (np.repeat(pose_cell[part], rays, axis=0), np.repeat(pose[part], rays, axis=0))
        beams = np.tile(ray[:rays], (count, 1))
        t = cast_ray(flags, map_table, window, *lanes, beams, scale.limit, caster)
        ranges[first * rays : part.stop * rays] = expected_range(flags, t, scale)


def cast_tiles(
    flags: frozenset[str], map_table: np.ndarray, pose_cell: np.ndarray, pose: np.ndarray, order: np.ndarray,
    ray: np.ndarray, ranges: np.ndarray, window: structs.Window, particles: int, rays: int, caster: structs.Caster,
    scale: structs.RangeScale, spread: int,
) -> None:  # fmt: skip
    """Cast all rays of all particles; GPUs do so in tiles of particles and rays."""
    cast_ranges(flags, map_table, pose_cell, pose, ray, ranges, window, particles, rays, caster, scale)  # fmt: skip
