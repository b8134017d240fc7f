"""Scans of a moving robot: motion during a scan, readings without it, matches and maps before and after."""

from __future__ import annotations

import numpy as np
import pytest
from support.matching_scenes import RING, ROOM, segments_scan

import gpusense as gs
from gpusense.world.deskew import beam_poses

MOVING = gs.Scanner(RING.bearings[::2], range_max=30.0, mount=(0.2, 0.1, 0.3))
# The second scans turn in the other direction.
BACK = np.array([1.0, 1.0, -1.0])
# Walls run through the centres of cells.
ORIGIN = (-5.01, -4.01, 0.0)


def moved(pose, motion):
    """Return poses in the world from one pose and (..., 3) poses in its frame."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    x, y, theta = np.moveaxis(np.asarray(motion), -1, 0)
    return np.stack([pose[0] + c * x - s * y, pose[1] + s * x + c * y, pose[2] + theta], axis=-1)


def measured(pose, motion, scanner):
    """Return the scan of a moving robot, beam by beam, from closed forms of its path in 2000 small steps."""
    steps = 2000
    inverse = np.linalg.inv(arc(motion[2])) @ motion[:2]
    ranges = []
    for k, bearing in enumerate(scanner.bearings):
        share = round(k / (scanner.count - 1) * steps) / steps
        here = moved(pose, (*(arc(share * motion[2]) @ (share * inverse)), share * motion[2]))
        sensor = moved(here, scanner.mount)
        ranges.append(segments_scan(ROOM, tuple(sensor), gs.Scanner([bearing], range_max=30.0))[0])
    return np.array(ranges)


def arc(turn):
    """Return the matrix that maps a body's velocity to a displacement: the integral of its rotations."""
    share = (np.arange(4000) + 0.5) / 4000 * turn
    c, s = np.cos(share).mean(), np.sin(share).mean()
    return np.array([[c, -s], [s, c]])


@pytest.fixture(scope="module")
def drive():
    """Return poses and motions of a robot that drives (1 m/s, up to 1.2 rad/s, 5 scans a second), and its scans."""
    rng = np.random.default_rng(2)
    first = np.column_stack([rng.uniform(-1.2, 1.0, (8, 2)), rng.uniform(-3, 3, 8)])
    motion = np.column_stack([rng.uniform(0.1, 0.2, 8), rng.uniform(-0.02, 0.02, 8), rng.uniform(-0.24, 0.24, 8)])
    second = np.array([moved(pose, step) for pose, step in zip(first, motion, strict=True)])
    scans = [
        np.array([measured(pose, step, MOVING) for pose, step in zip(poses, way, strict=True)])
        for poses, way in ((first, motion), (second, motion * BACK))
    ]
    return first, second, motion, *scans


def test_velocities_are_constant():
    motion = np.array([[0.3, 0.1, 0.5], [0.3, 0.1, 0.0], [0.0, 0.0, -2.0]])
    place, heading = beam_poses(motion, 5)
    np.testing.assert_allclose(place[:, -1], motion[:, :2])
    np.testing.assert_allclose(heading, motion[:, 2:] * np.linspace(0, 1, 5))
    # The same small motion leads from each beam to the next.
    poses = np.column_stack([place[0], heading[0]])
    steps = gs.pose_difference(poses[:-1], poses[1:])
    np.testing.assert_allclose(steps, np.repeat(steps[:1], 4, axis=0), atol=1e-12)


def test_readings_are_those_of_a_robot_at_rest(drive):
    first, _, motion, scans, _ = drive
    rest = np.array([segments_scan(ROOM, tuple(moved(pose, MOVING.mount)), MOVING) for pose in first])
    still = gs.deskew_scan(scans, MOVING, motion)
    before, after = np.abs(scans - rest), np.abs(still - rest)
    # Walls are straight: all but beams near corners and edges are exact.
    assert np.nanmedian(before) > 0.05
    assert np.nanmedian(after) < 1e-3
    assert np.nanpercentile(after, 85) < 0.02
    assert np.isnan(still).mean() < 0.05
    np.testing.assert_allclose(gs.deskew_scan(rest, MOVING, (0.0, 0.0, 0.0)), rest, atol=1e-9)
    np.testing.assert_array_equal(gs.deskew_scan(scans[0], MOVING, motion[0]), still[0])


@pytest.mark.parametrize("method", ["auto", "gauss_newton"])
def test_matches_between_scans_lose_the_error_of_the_motion(drive, method):
    first, second, motion, one, two = drive
    truth = gs.pose_difference(first, second)
    ways = dict(motion=motion * BACK, reference_motion=motion)
    found, skewed = (gs.match_scan(one, two, MOVING, truth, method, "opencl", **way) for way in (ways, {}))
    before, after = (np.hypot(*(match.pose - truth)[:, :2].T) for match in (skewed, found))
    # Cells of a field have sides of 5 cm.
    assert np.median(after) < (0.001 if method == "auto" else 0.02) and np.median(after) < 0.6 * np.median(before)
    assert np.degrees(np.median(np.abs(found.pose - truth)[:, 2])) < (0.1 if method == "auto" else 0.6)


def test_matches_to_maps_lose_the_error_of_the_motion(drive):
    first, _, motion, scans, _ = drive
    grid = gs.OccupancyGrid(room_cells(), 0.02, ORIGIN)
    found, skewed = (gs.match_scan(grid, scans, MOVING, first, backend="opencl", motion=way) for way in (motion, None))
    before, after = (np.hypot(*(match.pose - first)[:, :2].T) for match in (skewed, found))
    assert np.median(after) < 0.01 < 0.03 < np.median(before)


def room_cells():
    """Return cells of 2 cm whose walls are those of ROOM."""
    cells = np.zeros((410, 520), int)
    for x1, y1, x2, y2 in ROOM:
        t = np.linspace(0, 1, 2000)
        col, row = (np.floor((np.array([x1 + t * (x2 - x1), y1 + t * (y2 - y1)]).T - ORIGIN[:2]) / 0.02)).astype(int).T
        cells[row, col] = 100
    return cells


def test_maps_lose_the_error_of_the_motion(drive):
    """Walls of the map become sharper: fewer cells are occupied, and more of them are near a wall."""
    first, _, motion, scans, _ = drive
    walls = gs.distance_transform(room_cells() > 0, resolution=0.02, backend="numpy")
    errors = []
    for way in (None, motion):
        grid = gs.build_map(
            scans, first, MOVING, resolution=0.02, origin=ORIGIN, shape=(410, 520), motion=way,
            backend="opencl",
        )  # fmt: skip
        errors.append(float(np.mean(walls[grid.occupied] > 0.05)))
    assert errors[1] < 0.01 < 0.3 < errors[0]


@pytest.mark.parametrize("call", [
    lambda motion: gs.deskew_scan(np.ones(180), MOVING, motion),
    lambda motion: gs.match_scan(np.ones(180), np.ones(180), MOVING, motion=motion, backend="numpy"),
    lambda motion: gs.build_map(np.ones((2, 180)), np.zeros((2, 3)), MOVING, motion=motion, backend="numpy"),
])  # fmt: skip
def test_bad_motions_are_named(call):
    for motion in ((0.1, 0.2), (np.nan, 0.0, 0.0), np.zeros((5, 3))):
        with pytest.raises(ValueError, match=r"^motion"):
            call(motion)
    grid = gs.OccupancyGrid(room_cells(), 0.02)
    with pytest.raises(ValueError, match=r"^reference_motion"):
        gs.match_scan(grid, np.ones(180), MOVING, reference_motion=(0.1, 0.0, 0.0), backend="numpy")
