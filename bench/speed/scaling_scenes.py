"""Make maps of any size and clouds in them for scaling.py; count a ray's reads of the map's table."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.evaluation.worlds import building, cloud_around, free_pose
from gpusense.interface.structs import Caster, Window
from gpusense.reference import raycast
from gpusense.tables.rectangles import empty_rectangles, planes_of
from gpusense.world.frames import place_poses, ray_vectors

RANGE_MAX, RESOLUTION, LARGEST_BUILDING = 30.0, 0.05, 2000
CHECKED, COUNTED, WINDOW = 8, 512, 1400


@dataclass(frozen=True)
class Scene:
    """A map, a pose in it, and the cost of casting there."""

    grid: gs.OccupancyGrid
    pose: np.ndarray
    near: gs.OccupancyGrid
    seconds: float

    def cloud(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Draw poses over the free cells; the first ones are around the pose."""
        rows, cols = self.grid.shape
        cells = np.empty((0, 2))
        while len(cells) < count:
            row, col = rng.integers(rows, size=2 * count + 64), rng.integers(cols, size=2 * count + 64)
            free = self.grid.cells[row, col] == 0
            cells = np.concatenate([cells, np.stack([col[free], row[free]], axis=1)])
        places = (cells[:count] + rng.uniform(0.001, 0.999, (count, 2))) * self.grid.resolution
        poses = np.column_stack([places, rng.uniform(-np.pi, np.pi, count)])
        poses[:CHECKED] = cloud_around(self.pose, CHECKED, 0.1, 0.1, rng)[:count]
        return poses


def make_scene(side: int) -> Scene:
    """Make the built-in building, repeated side by side above its largest size."""
    start = time.perf_counter()
    rng = np.random.default_rng(0)
    resolution = RESOLUTION if side * RESOLUTION >= 10 else 10 / side
    one = building(0, (min(side, LARGEST_BUILDING) * resolution,) * 2, resolution)
    pose = free_pose(one, rng, 0.3)
    times = -(-side // LARGEST_BUILDING)
    grid = one
    if times > 1:
        grid = gs.OccupancyGrid(np.tile(one.cells, (times, times))[:side, :side], resolution)
    # The part in sight of the first particles, so that float64 NumPy need not prepare the whole map.
    reach = int((RANGE_MAX + 5) / resolution)
    col, row = (max(int(place / resolution) - reach, 0) for place in pose[:2])
    right, top = (int(place / resolution) + reach for place in pose[:2])
    near = grid.cells[row:top, col:right]
    part = gs.OccupancyGrid(np.ascontiguousarray(near), resolution, (col * resolution, row * resolution, 0.0))
    return Scene(grid, pose, part, time.perf_counter() - start)


class Counted:
    """A table that counts its reads."""

    def __init__(self, table: np.ndarray) -> None:
        self.table, self.reads = table, 0

    def __getitem__(self, at: np.ndarray) -> np.ndarray:
        self.reads += len(at)
        return self.table[at]


def count_reads(scene: Scene, backend: Any) -> tuple[float, float]:
    """Count mean reads and steps of a ray in the middle of the map; too few where rays end early."""
    rows, cols = (min(side, WINDOW) for side in scene.grid.shape)
    row, col = ((whole - part) // 2 for whole, part in zip(scene.grid.shape, (rows, cols), strict=True))
    size = scene.grid.resolution
    grid = gs.OccupancyGrid(
        np.ascontiguousarray(scene.grid.cells[row : row + rows, col : col + cols]), size, (0.0, 0.0, 0.0)
    )
    rng = np.random.default_rng(1)
    poses = Scene(grid, np.array([0.5 * cols * size, 0.5 * rows * size, 0.0]), grid, 0.0).cloud(COUNTED, rng)[CHECKED:]
    form = planes_of(backend, *scene.grid.shape)
    planes = empty_rectangles(backend, grid.obstacles("free"), form)
    table = Counted(backend.download(planes, np.empty(form.entries(rows, cols), np.uint16)))
    placed = place_poses(poses, grid, (0.0, 0.0, 0.0), np.dtype(np.float32))
    rays = ray_vectors(rng.uniform(-np.pi, np.pi, len(poses)), (0.0, 0.0, 0.0)).astype(np.float32)
    limit = np.float32(RANGE_MAX / size)
    found = raycast.cast_ray(
        form.flags, table, Window(0, 0, rows, cols), placed.cell, placed.pose, rays, limit, Caster(0, 0.0, 0.0)
    )  # type: ignore[arg-type]
    # The read that finds an obstacle is not a step.
    return table.reads / len(poses), (table.reads - np.count_nonzero(found < limit)) / len(poses)
