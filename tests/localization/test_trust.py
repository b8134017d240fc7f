"""A start anywhere on the map is repeated while scans contradict the pose that it has found."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import gpusense as gs
from gpusense.localization.trust import Trust

HERE = gs.Estimate(np.zeros(3), np.eye(3) * 0.01, 100.0, 0.0, "tracking", 0.9, 0.1, 1.0, False, 100)


def judged(trust: Trust, x: float, *, lost: bool, deviation: float = 0.1) -> bool:
    covariance = np.diag([deviation**2, deviation**2, 0.01])
    pose = np.array([x, 0.0, 0.0])
    return trust.contradicted(
        dataclasses.replace(
            HERE, pose=pose, covariance=covariance, p_lost=float(lost), verdict="lost" if lost else "tracking"
        )
    )


def test_trust_grows_and_falls_with_the_way():
    trust = Trust()
    assert judged(trust, 0.0, lost=True)
    # Particles that lie apart have no pose that scans could contradict.
    assert not judged(trust, 0.0, lost=True, deviation=2.0)
    # Scans at one place count once, for a pose and against it.
    for _ in range(20):
        assert not judged(trust, 1.0, lost=False)
    assert not judged(trust, 2.0, lost=True) and judged(trust, 2.0, lost=True)
    for k in range(3):
        assert not judged(trust, 3.0 + k, lost=False)
    for _ in range(20):
        assert not judged(trust, 5.0, lost=True)
    assert [judged(trust, 6.0 + k, lost=True) for k in range(4)] == [False, False, False, True]


@pytest.fixture(scope="module")
def run():
    """A house, the poses of a run in it, and scans, the first of which show other furniture."""
    cells = np.pad(np.zeros((60, 90), int), 1, constant_values=100)
    cells[1:40, 30], cells[20:61, 60], cells[30, 60:80] = 100, 100, 100
    cells[10:14, 8:12], cells[45:48, 20:30], cells[12:20, 70:73] = 100, 100, 100
    moved = cells.copy()
    moved[1:61, 1:12], moved[18, 12:31], moved[45:61, 1:40] = 100, 100, 100
    grid, before = gs.OccupancyGrid(cells, 0.1), gs.OccupancyGrid(moved, 0.1)
    scanner = gs.Scanner.uniform(angle_min=-3.1, angle_increment=0.2, count=32, range_max=12.0)
    poses = [np.array([2.0, 3.0, 0.3])] * 12
    for k in range(40):
        poses.append(gs.compose_poses(poses[-1], (0.12, 0.0, 0.05 if k < 20 else -0.05)))
    scans = [
        gs.RayCaster(before if k < 14 else grid, range_max=12.0, backend="numpy").cast(pose[None], scanner.bearings)[0]
        for k, pose in enumerate(poses)
    ]
    return grid, scanner, poses, scans


def error(run, *, everywhere: bool, seed: int) -> float:
    grid, scanner, poses, scans = run
    model = gs.LikelihoodFieldModel(grid, scanner, gs.LikelihoodFieldParameters(z_rand=0.3, z_hit=0.7, sigma_hit=0.07),
                                    backend="numpy")  # fmt: skip
    pf = gs.ParticleFilter(model, particles=1500, seed=seed)
    pf.initialize_uniform(bounds=None if everywhere else ((0.1, 0.1), (9.1, 6.1)))
    for k, scan in enumerate(scans):
        if k:
            pf.predict(poses[k - 1], poses[k])
        pf.correct(scan)
    return float(np.hypot(*(pf.estimate().pose - poses[-1])[:2]))


def test_a_start_where_the_map_is_wrong_finds_the_robot_later(run):
    assert error(run, everywhere=True, seed=0) < 0.15 and error(run, everywhere=True, seed=1) < 0.15
    # A start within bounds is not repeated.
    assert error(run, everywhere=False, seed=0) > 1.0
