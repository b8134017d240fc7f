"""Matches of scans to maps, and by methods that make a map from a single scan."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from support.matching_scenes import FRONT, RING, ROOM, random_pairs, segments_scan, table_legs
from support.selection import present

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.matching.match import WINDOW, match_log
from gpusense.matching.options import MatchOptions
from gpusense.matching.points import match_noise, scan_noise
from gpusense.matching.to_map import MapMatcher


@pytest.mark.parametrize("moving", [False, True])
def test_matches_of_a_log_are_those_of_its_pairs(moving):
    """A scan in pairs of several noise levels has lines for each level."""
    rng = np.random.default_rng(0)
    path = np.cumsum(rng.uniform(-0.1, 0.15, (9, 3)), axis=0)
    noise = np.array([0.01, 0.04, 0.01, 0.02, 0.08, 0.01, 0.02, 0.01, 0.04])
    walls = np.concatenate([ROOM, table_legs(1)])
    scans = np.array([segments_scan(walls, tuple(pose), RING) for pose in path])
    scans += noise[:, None] * rng.normal(size=scans.shape)
    motion = rng.uniform(-0.05, 0.05, (9, 3)) if moving else None
    first, second = np.array([0, 0, 1, 2, 2, 3, 5, 0, 7]), np.array([1, 2, 2, 3, 4, 5, 6, 7, 8])
    guess, own = rng.uniform(-0.1, 0.1, (9, 3)), scan_noise(scans, RING)
    levels = np.unique(match_noise(own[first], own[second]))
    device = present("opencl")
    found = match_log(scans, RING, first, second, guess, own, get_backend(device), "float32", WINDOW, motion)
    expected = gs.match_scan(
        scans[first], scans[second], RING, guess, backend=device,
        motion=None if motion is None else motion[second], reference_motion=None if motion is None else motion[first],
    )  # fmt: skip
    assert len(levels) >= 3
    for field in dataclasses.fields(found):
        np.testing.assert_array_equal(getattr(found, field.name), getattr(expected, field.name), err_msg=field.name)


def drawn(origin=(0.0, 0.0, 0.0)):
    """Return a map of 5 cm of a room with two blocks in a frame anywhere."""
    cells = np.zeros((150, 190), int)
    cells[[0, -1]] = 100
    cells[:, [0, -1]] = 100
    cells[70:95, 120:140] = 100
    cells[30:50, 40:55] = 100
    return gs.OccupancyGrid(cells, resolution=0.05, origin=origin)


@pytest.fixture(scope="module")
def local():
    rng = np.random.default_rng(7)
    return np.column_stack([rng.uniform(3.0, 5.5, 12), rng.uniform(2.6, 3.3, 12), rng.uniform(-3, 3, 12)])


def scans_at(grid, poses):
    return gs.RayCaster(grid, range_max=30.0, backend="numpy", precision="float64").cast(poses, RING.bearings)


def errors(match, truth):
    turn = np.angle(np.exp(1j * (match.pose[:, 2] - truth[:, 2])))
    return np.hypot(*(match.pose - truth).T[:2]), np.abs(turn)


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (5e6, -4e6, 0.6)], ids=["near", "far and yawed"])
def test_poor_guesses_in_a_map_are_corrected_to_a_fraction_of_a_cell(device, local, origin):
    grid = drawn(origin)
    truth = gs.compose_poses(grid.origin, local)
    rng = np.random.default_rng(1)
    guess = truth + np.column_stack([rng.uniform(-0.5, 0.5, (12, 2)), np.radians(rng.uniform(-10, 10, 12))])
    match = gs.match_scan(grid, scans_at(grid, truth), RING, guess, backend=device)
    assert match.converged.all()
    distance, turn = errors(match, truth)
    assert np.median(distance) < 0.1 * grid.resolution
    assert distance.max() < 0.5 * grid.resolution
    assert np.degrees(np.median(turn)) < 0.02


@pytest.mark.parametrize(("method", "cells"), [("gauss_newton", 1.0), ("correlative", 2.5)])
def test_fields_find_poses_to_the_cell(device, local, method, cells):
    grid = drawn((1.0, 2.0, 0.3))
    truth = gs.compose_poses(grid.origin, local)
    match = gs.match_scan(
        grid, scans_at(grid, truth), RING, truth + np.array([0.15, -0.1, 0.05]), method, backend=device
    )
    distance, turn = errors(match, truth)
    assert np.median(distance) < cells * grid.resolution
    assert np.median(turn) < 0.02
    assert (np.linalg.eigvalsh(match.covariance) > 0).all()


def test_the_search_returns_the_best_pose_of_its_grid(local):
    """No pose of the window has a better integer score than a correlative match, by brute force."""
    grid = drawn()
    matcher = MapMatcher(grid, RING, get_backend("numpy"), "float32", MatchOptions(0.01, 1.0, (0.3, 0.1)))
    scans = scans_at(grid, local[:2])
    guess = local[:2] + np.array([0.1, 0.1, 0.05])
    pose = matcher.searched(scans, guess)
    original = matcher._search.find
    matcher._search.find = lambda points, poses, allowed: original(points, poses, level=0, allowed=allowed)
    np.testing.assert_array_equal(pose, matcher.searched(scans, guess))


@pytest.mark.parametrize("method", ["gauss_newton", "correlative"])
def test_methods_of_maps_match_scans_to_scans(method):
    first, second, truth = random_pairs(2, FRONT, seed=8)
    match = gs.match_scan(first, second, FRONT, truth + np.array([0.05, 0.05, 0.02]), method, backend="numpy")
    distance, turn = errors(match, truth)
    assert distance.max() < 0.1
    assert turn.max() < 0.05


def test_a_single_scan_gives_a_single_match(local):
    grid = drawn()
    scan = scans_at(grid, local[:1])[0]
    match = gs.match_scan(grid, scan, RING, local[0], backend="numpy")
    assert isinstance(match.status, str)
    assert match.pose.shape == (3,)
    with pytest.raises(ValueError, match="method"):
        gs.match_scan(grid, scan, RING, local[0], "icp", backend="numpy")


@pytest.mark.parametrize("method", ["auto", "gauss_newton", "correlative"])
def test_no_scans_give_no_matches(method):
    match = gs.match_scan(drawn(), np.zeros((0, RING.count)), RING, np.zeros((0, 3)), method, backend="numpy")
    assert len(match) == 0 and match.covariance.shape == (0, 3, 3)


@pytest.mark.long
def test_matches_in_corridors_of_a_recorded_map_stay_at_good_guesses(data_dir):
    """ICP would slide along the corridor for some of these scans, for one of them by 0.95 m."""
    folder = data_dir / "carmen_logs"
    grid = gs.read_map(folder / "derived_maps/aces_even_05cm.yaml")
    scans = list(gs.read_log(folder / "aces-corrected.log.gz"))[1::2][90:150]
    poses = np.array([scan.pose for scan in scans])
    match = gs.match_scan(
        grid, np.array([scan.ranges for scan in scans]), scans[0].scanner, poses + np.array([0.02, 0.0, 0.0]),
        backend=present("opencl"),
    )  # fmt: skip
    assert np.hypot(*(match.pose - poses)[:, :2].T).max() < 0.3
