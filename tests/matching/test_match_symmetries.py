"""Matches of scans and maps that are turned, mirrored, or have beams in another order."""

from __future__ import annotations

import math

import numpy as np
import pytest

import gpusense as gs

BEARINGS = np.linspace(-2.2, 2.2, 221)
TRUTH = np.array([0.12, -0.07, 0.06])
CELL = 0.05


def room(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    cells = np.pad(np.zeros((90, 130), int), 1, constant_values=100)
    for row, col in rng.integers(5, (80, 120), (9, 2)):
        cells[row : row + rng.integers(3, 12), col : col + rng.integers(3, 12)] = 100
    return cells


def scans(count: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return poses on free cells of the room, and readings there and after a motion."""
    grid, rng = gs.OccupancyGrid(room(), CELL), np.random.default_rng(1)
    wide = np.argwhere(gs.distance_transform(grid.occupied, resolution=CELL, backend="numpy") > 0.4)
    row, col = wide[rng.integers(0, len(wide), count)].T
    poses = np.column_stack([(col + 0.5) * CELL, (row + 0.5) * CELL, rng.uniform(-3, 3, count)])
    caster = gs.RayCaster(grid, 12.0, backend="numpy")
    both = [caster.cast(at, BEARINGS) for at in (poses, gs.compose_poses(poses, TRUTH))]
    return poses, *(ranges + rng.normal(0, 0.01, ranges.shape) for ranges in both)


def turned(poses: np.ndarray, angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.column_stack([poses[:, :2] @ np.array([[c, s], [-s, c]]), poses[:, 2] + angle])


def assert_near(one: np.ndarray, two: np.ndarray, most: float = 1e-6) -> None:
    np.testing.assert_allclose(one[:, :2], two[:, :2], atol=most)
    np.testing.assert_allclose(gs.wrap_angle(one[:, 2] - two[:, 2]), 0, atol=most)


@pytest.mark.long
@pytest.mark.parametrize("method", ["auto", "icp", "gauss_newton", "correlative"])
@pytest.mark.parametrize("noise", ["auto", 0.02])
def test_matches_turn_and_mirror_with_scans(method, noise):
    _, first, second = scans()

    def match(bearings, one=first, two=second, **options):
        scanner = gs.Scanner(bearings, 12.0, **options)
        return gs.match_scan(
            one, two, scanner, np.zeros((3, 3)), method=method, noise=noise, backend="opencl", precision="float64"
        ).pose

    found = match(BEARINGS)
    assert np.abs(found - TRUTH).max() < (0.1 if method == "correlative" else 0.02)
    for shift in (1, 60):
        rolled = (np.roll(ranges, shift, axis=1) for ranges in (first, second))
        assert_near(match(np.roll(BEARINGS, shift), *rolled), found)
    for angle in (0.7, 2.0, -3.0):
        seen = match(BEARINGS, mount=(0.0, 0.0, angle))
        np.testing.assert_allclose(turned(seen, -angle)[:, :2], found[:, :2], atol=1e-6)
        np.testing.assert_allclose(seen[:, 2], found[:, 2], atol=1e-6)
    if noise != "auto":
        # The noise of a scan comes from some beams, which depend on the sense of bearings.
        assert_near(match(-BEARINGS) * (1, -1, -1), found)
        assert_near(match(-BEARINGS[::-1], first[:, ::-1], second[:, ::-1]) * (1, -1, -1), found)


@pytest.mark.parametrize("method", ["auto", "gauss_newton", "correlative"])
def test_matches_in_a_map_turn_with_it(method):
    poses, ranges, _ = scans()
    scanner, guess = gs.Scanner(BEARINGS, 12.0), poses + np.array([0.08, -0.05, 0.04])
    options = dict(method=method, noise=0.02, backend="opencl", precision="float64")
    found = gs.match_scan(gs.OccupancyGrid(room(), CELL), ranges, scanner, guess, **options).pose
    for yaw in (0.3, 1.0, math.pi / 2):
        grid = gs.OccupancyGrid(room(), CELL, (0.0, 0.0, yaw))
        again = gs.match_scan(grid, ranges, scanner, turned(guess, yaw), **options).pose
        assert_near(turned(again, -yaw), found)


@pytest.mark.parametrize(("precision", "most"), [("float64", 1e-6), ("float32", 3e-4)])
def test_a_location_turns_with_the_map(precision, most):
    _, ranges, _ = scans()

    def located(yaw):
        grid = gs.OccupancyGrid(room(), CELL, (2.0, -1.0, yaw))
        model = gs.LikelihoodFieldModel(grid, gs.Scanner(BEARINGS, 12.0), backend="opencl", precision=precision)
        poses = [gs.locate_scan(model, one, resolution=0.1, angle=0.035).pose for one in ranges]
        return turned(np.array(poses) - (2.0, -1.0, 0.0), -yaw)

    found = located(0.0)
    for yaw in (0.3, 1.0, 2.5):
        assert_near(located(yaw), found, most)


def test_a_match_of_maps_turns_with_either_map():
    cells = room()
    part = np.array(cells[20:75, 30:100])

    def matched(yaw, other):
        grid = gs.OccupancyGrid(cells, CELL, (1.0, 2.0, yaw))
        local = gs.OccupancyGrid(part, CELL, (0.0, 0.0, other))
        return gs.match_map(local, grid, backend="opencl").pose

    found = matched(0.0, 0.0)
    np.testing.assert_allclose(found, (1.0 + 30 * CELL, 2.0 + 20 * CELL, 0.0), atol=1e-4)
    for yaw, other in ((0.4, 0.0), (0.0, 0.7), (-1.0, 2.0)):
        off = turned((found - (1.0, 2.0, 0.0))[None], yaw)[0] + (1.0, 2.0, -other)
        assert_near(matched(yaw, other)[None], off[None], 1e-3 * CELL)
