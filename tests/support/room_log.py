"""Maps and synthetic CARMEN logs as files."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs


def write_log(
    path: Path, ranges: Iterable[Any], poses: Sequence[Any], odometry: Sequence[Any] | None = None, period: float = 1.0
) -> Path:
    """Write scans with their poses as a CARMEN log; by default the odometry repeats the poses."""
    lines = []
    for i, (z, *places) in enumerate(zip(ranges, poses, poses if odometry is None else odometry, strict=True)):
        numbers = " ".join(f"{value:.4f}" for value in [*z, *places[0], *places[1]])
        lines.append(f"FLASER {len(z)} {numbers} {i * period:.1f} robot {i * period:.1f}")
    path.write_text("\n".join(lines) + "\n")
    return path


def write_building(
    folder: Path, scans: int, beams: int, parameters: gs.BeamParameters | None = None
) -> tuple[gs.OccupancyGrid, gs.Scanner, list[Any], list[Any]]:
    """Write ``map.yaml`` of a building and ``run.log`` with scans anywhere in it; return also poses and ranges."""
    grid, random = gs.worlds.building(2, (14.0, 12.0)), np.random.default_rng(4)
    gs.write_map(grid, folder / "map.yaml")
    scanner = gs.Scanner.uniform(
        angle_min=-math.pi / 2, angle_increment=math.pi / (beams - beams % 2), count=beams, range_max=10.0
    )
    poses, ranges = [], []
    for _ in range(scans):
        poses.append(gs.worlds.free_pose(grid, random))
        ranges.append(gs.worlds.simulate_scan(grid, scanner, poses[-1], parameters or gs.BeamParameters(), random))
    write_log(folder / "run.log", [np.minimum(z, 10.0) for z in ranges], poses)
    return grid, scanner, poses, ranges


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
    ranges, poses, odometry = [], [np.array([3.0, 1.5, 0.2])], [np.zeros(3)]
    for _ in range(scans):
        ranges.append(caster.cast(poses[-1][None], bearings)[0] + rng.normal(0, 0.02, len(bearings)))
        poses.append(gs.compose_poses(poses[-1], rng.normal((0.2, 0, 0.1), 0.01)))
        odometry.append(gs.compose_poses(odometry[-1], (0.2, 0, 0.1)))
    write_log(folder / "run.log", ranges, poses[:-1], odometry[:-1])
