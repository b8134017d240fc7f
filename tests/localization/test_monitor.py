"""``PoseMonitor``: the verdict on the poses of any localiser, its evidence and likely causes, and bad input."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

import gpusense as gs

CELLS = np.pad(np.zeros((60, 80), int), 1, constant_values=100)
CELLS[1:40, 51] = 100
CELLS[45:50, 10:20] = 100
GRID = gs.OccupancyGrid(CELLS, 0.1)
# A laser of 200 degrees sees differently after a turn.
SCANNER = gs.Scanner.uniform(angle_min=-1.75, angle_increment=3.5 / 70, count=71, range_max=12.0)
POSES = [np.array([2.0 + 0.2 * k, 2.0, 0.1 * k]) for k in range(10)]


def scan_at(pose, grid=GRID):
    return gs.RayCaster(grid, range_max=12.0, backend="numpy").cast(pose[None], SCANNER.bearings)[0].astype(float)


@pytest.fixture(params=["field", "beam"])
def model(request):
    if request.param == "field":
        return gs.LikelihoodFieldModel(GRID, SCANNER, backend="numpy")
    return gs.BeamModel(GRID, SCANNER, gs.BeamParameters(), backend="numpy")


def watched(model, poses, scans, covariance=None):
    monitor = gs.PoseMonitor(model)
    return monitor, [monitor.update(*one, covariance) for one in zip(poses, scans, strict=True)]


def test_right_poses_are_tracked_and_wrong_ones_lost(model):
    scans = [scan_at(pose) for pose in POSES]
    monitor, found = watched(model, POSES, scans)
    assert all(one.verdict == "tracking" for one in found) and found[-1].p_lost < 0.02 and found[-1].explained > 0.95
    assert monitor.diagnose().cause == "none" and "agree with the map" in str(monitor.diagnose())
    monitor, found = watched(model, [pose + np.array([3.5, 2.0, 1.5]) for pose in POSES], scans)
    assert found[-1].verdict == "lost" and found[-1].lost and found[-1].p_lost > 0.9 and found[-1].explained < 0.5
    told = monitor.diagnose()
    assert told.cause == "start" and math.dist(told.elsewhere[:2], POSES[-1][:2]) < 0.3
    assert "wrong start" in told.text and monitor.diagnose(search=False).elsewhere is None


def test_a_pose_beyond_any_map_is_lost(model):
    for far in (1e9, 1e308):
        _, found = watched(model, [np.array([far, -far, 0.5])] * 4, [scan_at(pose) for pose in POSES[:4]])
        assert found[-1].verdict in ("uncertain", "lost") and math.isnan(found[-1].explained)


@pytest.mark.sampled(1)
def test_wrong_maps_and_wrong_mounts_are_distinguished(model):
    blocks = np.zeros((80, 80), int)
    for row, column in np.ndindex(4, 4):
        blocks[20 * row + 6 : 20 * row + 14, 20 * column + 6 : 20 * column + 14] = 100
    other = gs.OccupancyGrid(blocks, 0.1)
    wrong = type(model)(other, SCANNER, model.parameters, backend="numpy")
    monitor, found = watched(wrong, POSES, [scan_at(pose) for pose in POSES])
    assert found[-1].verdict == "lost" and monitor.diagnose().cause == "map"
    assert "% of the beams that meet walls pass through them, most near x = " in monitor.diagnose().text
    # The laser is turned by 90 degrees, or upside down.
    turned = [scan_at(pose + np.array([0.0, 0.0, math.pi / 2])) for pose in POSES]
    monitor, found = watched(model, POSES, turned)
    assert found[-1].verdict == "lost" and monitor.diagnose().cause == "mount"
    assert monitor.diagnose().turned == pytest.approx(math.pi / 2, abs=0.1)
    monitor, found = watched(model, POSES, [scan_at(pose)[::-1] for pose in POSES])
    if found[-1].verdict == "lost":
        assert monitor.diagnose().cause == "mount" and monitor.diagnose().mirrored


def test_a_mount_is_found_beside_sensors_without_scans(model):
    """Only scans can be mirrored: a heading has no beams."""
    compass = gs.HeadingModel(backend="numpy")
    monitor = gs.PoseMonitor([model, compass])
    for pose in POSES:
        monitor.update(pose, {model: scan_at(pose + np.array([0.0, 0.0, math.pi / 2])), compass: float(pose[2])})
    found = monitor.diagnose()
    assert found.cause == "mount" and found.turned == pytest.approx(math.pi / 2, abs=0.1) and not found.mirrored


def test_people_are_named(model):
    scans = [np.where(np.arange(71) % 2 == 0, scan_at(pose), 0.5) for pose in POSES]
    monitor, found = watched(model, POSES, scans)
    assert found[-1].verdict == "tracking" and monitor.diagnose().cause == "people"


def test_covariances(model):
    scan = scan_at(POSES[0])
    for covariance, word, p_lost in (
        (np.diag([1e-4, 1e-4, 1e-4]), "tracking", 0.05),
        (np.diag([0.36, 0.36, 0.01]), "uncertain", 0.4),
        (np.diag([400.0, 400.0, 1.0]), "uncertain", 1.0),
        (np.diag([np.inf, 0.01, 0.01]), "uncertain", 1.0),
    ):
        found = gs.PoseMonitor(model).update(POSES[0], scan, covariance)
        assert found.verdict == word and p_lost - 0.2 <= found.p_lost <= p_lost


def test_state_and_reset(model):
    scans = [scan_at(pose) for pose in POSES]
    monitor, found = watched(model, POSES, scans)
    state, wrong = monitor.state, POSES[-1] + np.array([3.5, 2.0, 1.5])
    first = monitor.update(wrong, scans[-1])
    monitor.state = state
    assert monitor.update(wrong, scans[-1]) == first
    monitor.reset()
    assert monitor.update(POSES[0], scans[0]) == found[0]
    with pytest.raises(TypeError, match="state: must be that of a PoseMonitor"):
        monitor.state = 3
    with pytest.raises(RuntimeError, match="needs an update"):
        gs.PoseMonitor(model).diagnose()


def test_arrays_may_be_overwritten_after_an_update(model):
    pose, ranges, covariance = POSES[0].copy(), scan_at(POSES[0]), np.diag([0.01, 0.01, 0.001])
    arrays = pose, ranges, covariance
    for given in (arrays, arrays[:2]):
        _, (kept,) = watched(model, [POSES[0]], [ranges.copy()], *(one.copy() for one in given[2:]))
        monitor, (found,) = watched(model, [pose], [ranges], *given[2:])
        for array in given:
            array *= 0.5
        assert found.protection_level(0.05) == kept.protection_level(0.05) and monitor.diagnose().cause == "none"
        for array in given:
            array *= 2


def test_missing_readings_give_no_evidence(model):
    monitor = gs.PoseMonitor(model)
    for _ in range(5):
        found = monitor.update(POSES[0], np.full(71, np.nan))
        assert math.isnan(found.explained) and found.p_lost == pytest.approx(0.1, abs=0.02)
    assert monitor.update(POSES[0], None).verdict == "uncertain"
    assert monitor.diagnose().text == "no beam meets mapped cells that give evidence"


def test_several_sensors_and_landmarks():
    front = gs.LikelihoodFieldModel(GRID, SCANNER, backend="numpy")
    points = np.random.default_rng(0).uniform(0, 8, (12, 2))
    landmarks = gs.LandmarkModel(gs.LandmarkMap(points), backend="numpy")
    # Both, and landmarks alone with a covariance of 0.
    for models, off in itertools.product(((front, landmarks), (landmarks,)), (0.0, 2.5)):
        monitor = gs.PoseMonitor(models)
        for pose in POSES:
            d = points - pose[:2]
            seen = np.column_stack([np.hypot(*d.T), gs.wrap_angle(np.arctan2(d[:, 1], d[:, 0]) - pose[2])])
            readings = {front: scan_at(pose), landmarks: (seen,)}
            found = monitor.update(pose + np.array([off, off, 0.0]), {model: readings[model] for model in models})
        assert found.verdict == ("lost" if off else "tracking")
        assert math.isnan(found.explained) == (front not in models)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((0, 0, np.nan), np.ones(71)), "pose"),
        (((0, 0, 0), np.ones(71), np.eye(2)), "covariance"),
        (((0, 0, 0), np.ones(71), np.diag([1.0, -1.0, 1.0])), "covariance: must have variances >= 0"),
        (((0, 0, 0), np.ones(71), np.full((3, 3), np.nan)), "covariance: must have no NaN"),
        (((0, 0, 0), np.ones(71), [[1, 2, 0], [0, 1, 0], [0, 0, 1]]), "covariance: must be symmetric"),
    ],
)
def test_bad_input_is_refused_and_changes_nothing(arguments, message):
    monitor = gs.PoseMonitor(gs.LikelihoodFieldModel(GRID, SCANNER, backend="numpy"))
    state = monitor.state
    with pytest.raises(ValueError, match=message):
        monitor.update(*arguments)
    assert monitor.state == state


def test_models_without_a_map_are_refused():
    with pytest.raises(ValueError, match="models: must have a map"):
        gs.PoseMonitor(gs.HeadingModel(gs.HeadingParameters(sigma=0.1), backend="numpy"))
    with pytest.raises(TypeError, match="models"):
        gs.PoseMonitor(3)
