"""Matches in maps that do not determine the pose: honest covariances and failures by every method in any frame."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.matching_scenes import CORRIDOR, FRONT, RING, ROOM, WALL, segments_scan

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.matching.options import MatchOptions
from gpusense.matching.to_map import observable_directions

METHODS = ["auto", "gauss_newton", "correlative"]
PLACES = {"near": (0.0, 0.0, 0.0), "far and yawed": (5e6, -4e6, 0.6)}
each_method = pytest.mark.parametrize("method", METHODS)


def drawn(segments, origin=(0.0, 0.0, 0.0)):
    """Return a map of 12 m x 12 m of walls around the scene's origin; long walls end at its edges."""
    cells = np.zeros((120, 120), int)
    along = np.linspace(0, 1, 8000)[:, None]
    for segment in segments:
        xy = segment[:2] + along * (segment[2:] - segment[:2])
        col, row = np.floor((xy + 6) / 0.1).astype(int).T
        inside = (col >= 0) & (col < 120) & (row >= 0) & (row < 120)
        cells[row[inside], col[inside]] = 100
    return gs.OccupancyGrid(cells, 0.1, origin)


def in_world(origin, pose):
    """Return a pose of the scene in the world of a map."""
    return gs.compose_poses(origin, pose + np.array([6.0, 6.0, 0.0]))


@each_method
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize(("segments", "scanner", "heading"), [(CORRIDOR, RING, 0.1), (WALL, FRONT, 1.5)],
                         ids=["corridor", "wall"])  # fmt: skip
def test_walls_in_a_map_leave_the_position_along_them_open(method, place, segments, scanner, heading):
    origin, pose = PLACES[place], np.array([0.3, 0.1, heading])
    scan = segments_scan(segments, tuple(pose), scanner) + np.random.default_rng(0).normal(0, 0.01, scanner.count)
    grid, guess = drawn(segments, origin), in_world(origin, pose + np.array([-0.2, 0.05, -0.05]))
    match = gs.match_scan(grid, scan, scanner, guess, method, backend="opencl")
    # The chain never comes to rest if the expected scan moves along the wall with every pose.
    assert match.status in {"unobservable", "no convergence"}
    assert np.isinf(match.covariance[0, 0])
    if match.usable:
        axis = match.directions[0]
        assert abs(axis[0] * math.cos(origin[2]) + axis[1] * math.sin(origin[2])) > 0.99
        assert match.covariance[2, 2] < 1e-3
        off = match.pose - in_world(origin, pose)
        assert abs(off[1] * math.cos(origin[2]) - off[0] * math.sin(origin[2])) < 0.15


@pytest.mark.parametrize("method", ["icp", *METHODS])
def test_a_corridor_of_two_scans_is_open_for_every_method(method):
    scans = [segments_scan(CORRIDOR, pose, FRONT) for pose in ((0.0, 0.0, 0.0), (0.2, 0.05, 0.05))]
    match = gs.match_scan(*scans, FRONT, method=method, backend="opencl")
    assert match.status == "unobservable"
    assert np.isinf(match.covariance[0, 0])
    assert abs(match.directions[0, 0]) > 0.99
    assert match.covariance[1, 1] < 0.05**2


@each_method
@pytest.mark.parametrize("case", ["3 beams", "nothing seen", "empty map", "off the map", "clutter"])
def test_what_a_map_does_not_say_is_a_failure(method, case):
    rng, grid, guess, scanner = np.random.default_rng(2), drawn(ROOM), np.array([6.0, 6.0, 0.0]), RING
    scan = segments_scan(ROOM, (0.0, 0.0, 0.0), RING)
    if case == "3 beams":
        scanner = gs.Scanner([-0.5, 0.0, 0.5], range_max=30.0)
        scan = segments_scan(ROOM, (0.0, 0.0, 0.0), scanner)
    elif case == "nothing seen":
        scan = np.full(360, np.inf)
    elif case == "empty map":
        grid = drawn(np.zeros((0, 4)))
    elif case == "off the map":
        guess = np.array([60.0, 60.0, 0.0])
    else:
        scan = rng.uniform(0.5, 8.0, 360)
    match = gs.match_scan(grid, scan, scanner, guess, method, backend="opencl")
    assert match.status in {"few points", "no overlap", "poor", "doubtful", "outside window"}
    assert not match.converged
    assert np.isinf(match.covariance.diagonal()).all()


def test_lines_of_a_scan_have_the_information_of_their_normals():
    """The information of a scan is the sum of J J' over its walls with known normals, in the robot's frame."""
    mount, scanner_pose = (0.3, -0.2, 0.0), (0.2, 0.1, 0.0)
    scanner = gs.Scanner(RING.bearings, range_max=30.0, mount=mount)
    scan, pose = segments_scan(ROOM[:4], scanner_pose, scanner), np.array([[5.0, -3.0, 0.7]])
    found = observable_directions(
        scan[None], pose, np.ones(1), scanner, get_backend("numpy"), np.dtype(np.float64), MatchOptions(0.01, 1.0, None)
    )
    place = scan[:, None] * np.stack([np.cos(scanner.bearings), np.sin(scanner.bearings)], axis=1)
    left_right = np.minimum(np.abs(place[:, 0] - (5 - 0.2)), np.abs(place[:, 0] - (-4 - 0.2))) < 1e-6
    normal = np.where(left_right[:, None], [1.0, 0.0], [0.0, 1.0])
    arm = place + mount[:2]
    turn = np.array([[np.cos(0.7), np.sin(0.7)], [-np.sin(0.7), np.cos(0.7)]])
    jacobian = np.column_stack([normal @ turn, normal[:, 1] * arm[:, 0] - normal[:, 0] * arm[:, 1]])
    expected = jacobian.T @ jacobian
    # Lines through corners have other normals.
    np.testing.assert_allclose(found[0], expected, rtol=0.1, atol=0.1 * np.abs(expected).max())
