"""A scene for filters that are split over devices; other processes can make its models."""

from __future__ import annotations

import functools

import numpy as np

import gpusense as gs

GRID = gs.OccupancyGrid(np.pad(np.zeros((60, 80), int), 2, constant_values=100), resolution=0.1)
SCANNER = gs.Scanner.uniform(angle_min=-3.0, angle_increment=0.2, count=30, range_max=10.0)
TRUTH = np.array([3.0, 2.5, 0.4])


def field(device):
    return gs.LikelihoodFieldModel(GRID, SCANNER, gs.LikelihoodFieldParameters(sigma_hit=0.1), backend=device)


def field_and_compass(device):
    return [field(device), gs.HeadingModel(gs.HeadingParameters(sigma=0.05), backend=device)]


@functools.cache
def scans(count):
    """Return the true poses of a run and its scans."""
    poses = [TRUTH]
    for _ in range(count):
        poses.append(gs.compose_poses(poses[-1], (0.2, 0, 0.1)))
    caster = gs.RayCaster(GRID, range_max=10.0, backend="numpy")
    return poses[1:], caster.cast(np.array(poses[1:]), SCANNER.bearings)


def states(pf, steps=4, *, everywhere=False):
    """Return the public state of a filter after each step of a run."""
    if everywhere:
        pf.initialize_uniform()
    else:
        pf.initialize(mean=TRUTH + np.array([0.2, -0.2, 0.1]), covariance=np.diag([0.1, 0.1, 0.03]))
    odometry, shown = np.zeros(3), []
    for pose, ranges in zip(*scans(steps), strict=True):
        moved = gs.compose_poses(odometry, (0.2, 0, 0.1))
        pf.predict(odometry, moved)
        odometry = moved
        models = [sensor.model for sensor in pf._sensors]
        pf.correct(ranges if len(models) == 1 else {models[0]: ranges, models[1]: float(pose[2])})
        e = pf.estimate()
        shown.append(
            np.concatenate([
                pf.host_particles().ravel(), pf.host_weights(), e.pose, e.covariance.ravel(),
                (e.effective_sample_size, e.temperature, e.used, e.particles),
            ])
        )  # fmt: skip
    return shown
