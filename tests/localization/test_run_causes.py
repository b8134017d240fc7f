"""The likely cause by the scans of a run: odometry, mount, times, map, scale and start, each with its evidence."""

from __future__ import annotations

import math

import numpy as np
import pytest

import gpusense as gs
from gpusense.localization.diagnosis import Diagnosis
from gpusense.localization.run_causes import RunEvidence, diagnose_run, likely_cause
from gpusense.localization.scan_motion import Moment, ScanMotion, scan_motion

BEARINGS = np.linspace(-2.0, 2.0, 121)
SCANNER = gs.Scanner(BEARINGS, range_max=15.0, mount=(0.2, 0.0, 0.0))
PARAMETERS = gs.LikelihoodFieldParameters(z_hit=0.7, z_rand=0.3, sigma_hit=0.07, interpolation="bilinear")


@pytest.fixture(scope="module")
def grid():
    return gs.worlds.building(seed=4, size=(24.0, 16.0))


@pytest.fixture(scope="module")
def run(grid):
    return simulated(grid)


def simulated(grid, scanner=SCANNER, **options):
    return gs.worlds.simulate_run(grid, scanner, scans=56, seed=3, **options)


def diagnosed(backend, grid, run, *, ranges=None, odometry=None, poses=None, search=True):
    model = gs.LikelihoodFieldModel(grid, SCANNER, PARAMETERS, backend=backend)
    parts = zip(
        run.scans if ranges is None else ranges, run.poses if poses is None else poses,
        run.odometry if odometry is None else odometry, run.times, strict=True,
    )  # fmt: skip
    return diagnose_run(model, [Moment(*one) for one in parts], search=search)


@pytest.fixture
def backend(needs):
    return needs("opencl")


def test_a_right_run_has_no_cause(backend, grid, run) -> None:
    found = diagnosed(backend, grid, run)
    assert found.cause == "none" and "pairs of scans match and agree with the odometry" in found.text
    assert "likely cause" not in found.text


@pytest.mark.sampled(1)
@pytest.mark.parametrize("kind", ["stands", "runs twice as fast", "turns"])
def test_scans_that_match_contradict_a_wrong_odometry(backend, grid, run, kind) -> None:
    steps = gs.pose_difference(run.odometry[:-1], run.odometry[1:])
    changed = {"stands": steps * 0, "runs twice as fast": steps * (2, 2, 1), "turns": steps + np.array([0, 0, 0.2])}[
        kind
    ]
    poses = [run.odometry[0]]
    for step in changed:
        poses.append(gs.compose_poses(poses[-1], step))
    # The localiser that follows this odometry is lost, on the right map.
    found = diagnosed(backend, grid, run, odometry=np.array(poses), poses=np.array(poses))
    assert found.cause == "odometry" and "match and contradict the odometry" in found.text
    assert found.text.endswith("likely cause: wrong odometry")


def test_a_turned_mount_is_measured(backend, grid) -> None:
    turned = gs.Scanner(BEARINGS, range_max=15.0, mount=(0.2, 0.0, math.radians(-12)))
    run = simulated(grid, turned)
    found = diagnosed(backend, grid, run, search=False)
    assert found.cause == "mount" and not found.mirrored
    assert math.degrees(found.turned) == pytest.approx(-12, abs=2)


def test_a_laser_upside_down_is_told_from_an_odometry_that_turns_the_other_way(backend, grid, run) -> None:
    found = diagnosed(backend, grid, run, ranges=run.scans[:, ::-1])
    assert found.cause == "mount" and found.mirrored and "mirrored" in found.text
    other = run.odometry * np.array([1.0, -1.0, -1.0])
    assert diagnosed(backend, grid, run, odometry=other).cause == "odometry"


def test_a_delay_is_measured(backend, grid, run) -> None:
    values = np.column_stack([run.odometry[:, :2], np.unwrap(run.odometry[:, 2])])
    late = np.stack([np.interp(run.times - 0.75, run.times, values[:, k]) for k in range(3)], axis=1)
    found = diagnosed(backend, grid, run, odometry=late)
    assert found.cause == "time" and found.delay == pytest.approx(0.75, abs=0.13)
    assert "s later" in found.text


@pytest.mark.long
def test_wrong_maps_are_told_from_wrong_scales(backend, grid, run) -> None:
    scaled = gs.OccupancyGrid(grid.cells, grid.resolution / 1.25, grid.origin)
    found = diagnosed(backend, scaled, run)
    assert found.cause == "scale" and found.scale == pytest.approx(1.25, rel=0.04)
    assert "true lengths are 1.2" in found.text
    blocks = np.zeros((150, 200), int)
    for row, column in np.ndindex(5, 7):
        blocks[30 * row + 8 : 30 * row + 20, 28 * column + 6 : 28 * column + 21] = 100
    assert diagnosed(backend, gs.OccupancyGrid(blocks, 0.1), run).cause == "map"


def test_a_moved_map_is_told_from_a_robot_that_was_carried_away(backend, grid, run) -> None:
    moved = gs.OccupancyGrid(grid.cells, grid.resolution, (grid.origin[0] + 2.0, grid.origin[1] - 1.0, 0.0))
    found = diagnosed(backend, moved, run)
    assert found.cause == "moved" and found.moved == pytest.approx((2.0, -1.0, 0.0), abs=0.2)
    # From the middle of the run on, the localiser goes on as if the robot had not been carried.
    poses = run.poses.copy()
    poses[30:] = gs.compose_poses(np.array([5.0, 2.0, 0.8]), poses[30:])
    found = diagnosed(backend, grid, run, poses=poses)
    assert found.cause == "start" and math.dist(found.elsewhere[:2], run.poses[-1][:2]) < 2.0


def test_one_jump_of_the_odometry_is_no_wrong_odometry(backend, grid, run) -> None:
    jumped = run.odometry.copy()
    jumped[35:] = gs.compose_poses(np.array([3.0, 1.0, 1.0]), jumped[35:])
    assert diagnosed(backend, grid, run, odometry=jumped).cause == "none"


def test_few_scans_and_no_odometry_blame_nothing(backend, grid, run) -> None:
    model = gs.LikelihoodFieldModel(grid, SCANNER, PARAMETERS, backend=backend)
    every = [Moment(*one) for one in zip(run.scans, run.poses, strict=True)]
    assert diagnose_run(model, []).cause == "unknown"
    assert diagnose_run(model, every[:2]).cause == "none"
    assert diagnose_run(model, every, search=False).cause in ("none", "unknown")
    nothing = [one._replace(ranges=np.full(121, np.nan)) for one in every[:20]]
    assert diagnose_run(model, nothing, search=False).cause in ("none", "unknown")
    assert scan_motion(every[:1], SCANNER, backend).pairs == 0


def test_mixed_evidence_is_unknown() -> None:
    motion = ScanMotion(20, 20, [], "none", 0.01, 0.01)
    beams = Diagnosis(10, 10, 0)
    unknown = likely_cause(beams, RunEvidence(motion, 5, as_is=0.5, mirrored=0.5))
    assert unknown.cause == "unknown" and unknown.text.endswith("; likely cause: unknown")
    assert likely_cause(beams, RunEvidence(motion, 5, as_is=0.2)).cause == "map"
    assert likely_cause(beams, RunEvidence(motion, 5, as_is=0.8, last=(1.0, 2.0, 0.0))).cause == "start"
    assert likely_cause(beams, RunEvidence(motion, 5, as_is=0.8)).cause == "unknown"


def test_a_scale_must_fit_more_windows_than_the_map_as_it_is() -> None:
    motion, beams = ScanMotion(20, 20, [], "none", 0.01, 0.01), Diagnosis(10, 10, 0)
    found = likely_cause(beams, RunEvidence(motion, 5, as_is=0.6, scaled=1.0, scale=0.9))
    assert found.cause == "scale" and found.scale == 0.9
    assert likely_cause(beams, RunEvidence(motion, 5, as_is=0.8, scaled=0.8, scale=0.9)).cause == "unknown"
    assert likely_cause(beams, RunEvidence(motion, 5, as_is=0.2, scaled=0.4, scale=0.9)).cause == "map"
