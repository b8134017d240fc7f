"""A room, a scanner and a short run for filters."""

from __future__ import annotations

import functools

import numpy as np

import gpusense as gs

GRID = gs.OccupancyGrid(np.pad(np.zeros((60, 80), int), 2, constant_values=100), resolution=0.1)
SCANNER = gs.Scanner.uniform(angle_min=-3.0, angle_increment=0.2, count=30, range_max=10.0)
FINE = gs.Scanner.uniform(angle_min=-3.0, angle_increment=0.1, count=60, range_max=10.0)
TRUTH = np.array([3.0, 2.5, 0.4])


def field(device):
    return gs.LikelihoodFieldModel(GRID, SCANNER, gs.LikelihoodFieldParameters(sigma_hit=0.1), backend=device)


def field_and_compass(device):
    return [field(device), gs.HeadingModel(gs.HeadingParameters(sigma=0.05), backend=device)]


def scan_at(pose, scanner=SCANNER, grid=GRID):
    """Return the exact ranges from a sensor's pose."""
    caster = gs.RayCaster(grid, scanner.range_max, backend="numpy")
    return caster.cast(np.array([pose]), scanner.bearings)[0].astype(float)


@functools.cache
def scans(count, scanner=SCANNER):
    """Return the true poses of a run and its scans."""
    poses = [TRUTH]
    for _ in range(count):
        poses.append(gs.compose_poses(poses[-1], (0.2, 0, 0.1)))
    caster = gs.RayCaster(GRID, range_max=10.0, backend="numpy")
    return poses[1:], caster.cast(np.array(poses[1:]), scanner.bearings)


def driven(pf, count, scanner=SCANNER):
    """Move and correct a filter along the run; return the last pose."""
    (poses, ranges), odometry = scans(count, scanner), np.zeros(3)
    for scan in ranges:
        moved = gs.compose_poses(odometry, (0.2, 0, 0.1))
        pf.predict(odometry, moved)
        pf.correct(scan)
        odometry = moved
    return poses[-1]
