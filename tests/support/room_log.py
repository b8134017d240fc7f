"""A map of a room and a synthetic log of a robot in it, as files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import gpusense as gs


def write_room_map(folder: Path) -> gs.OccupancyGrid:
    """Write ``map.yaml`` of a room with an inner wall, and return the map."""
    cells = np.pad(np.zeros((60, 80), int), 2, constant_values=100)
    cells[30, :26] = 100
    grid = gs.OccupancyGrid(cells, resolution=0.1)
    gs.write_map(grid, folder / "map.yaml")
    return grid


def write_room(folder: Path, *, scans: int = 6, seed: int = 0) -> None:
    """Write ``map.yaml`` and ``run.log``: 61 beams, logged poses and raw odometry."""
    grid = write_room_map(folder)
    bearings, rng = np.radians(np.arange(-90, 91, 3.0)), np.random.default_rng(seed)
    caster = gs.RayCaster(grid, range_max=20.0, backend="numpy")
    pose, odometry, lines = np.array([3.0, 1.5, 0.2]), np.zeros(3), []
    for step in range(scans):
        ranges = caster.cast(pose[None], bearings)[0] + rng.normal(0, 0.02, len(bearings))
        numbers = [*ranges, *pose, *odometry]
        lines.append(f"FLASER 61 {' '.join(f'{value:.4f}' for value in numbers)} {step}.0 robot {step}.0")
        pose = gs.compose_poses(pose, rng.normal((0.2, 0, 0.1), 0.01))
        odometry = gs.compose_poses(odometry, (0.2, 0, 0.1))
    (folder / "run.log").write_text("\n".join(lines))
