"""Matches of scans: accuracy, honest covariances in stiff cases, and arguments."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.matching_scenes import CORRIDOR, FRONT, RING, ROOM, SQUARE, WALL, random_pairs, segments_scan

import gpusense as gs
from gpusense.matching.verdicts import inflation_of
from gpusense.reference.icp_step import block_squares


@pytest.fixture(scope="module")
def pairs():
    return random_pairs(30, RING, seed=11)


def test_exact_pairs_are_matched_from_poor_guesses(device, pairs):
    first, second, truth = pairs
    rng = np.random.default_rng(0)
    guess = truth + np.column_stack([rng.uniform(-0.5, 0.5, (30, 2)), np.radians(rng.uniform(-10, 10, 30))])
    match = gs.match_scan(first, second, RING, guess, backend=device)
    assert match.converged.all()
    error = match.pose - truth
    # A tenth of a cell of 5 cm, and a fiftieth of a degree.
    assert np.median(np.hypot(*error.T[:2])) < 0.005
    assert np.degrees(np.median(np.abs(error[:, 2]))) < 0.02
    assert np.hypot(*error.T[:2]).max() < 0.05


def test_the_mount_moves_the_frame(pairs):
    """A scan from a sensor off the robot's centre gives the robot's pose, and its covariance."""
    mount = (0.3, -0.2, 0.7)
    scanner = gs.Scanner(RING.bearings, range_max=30.0, mount=mount)
    robot = np.array([0.2, -0.1, 0.3])
    scans = [segments_scan(ROOM, gs.compose_poses(pose, mount), scanner) for pose in (np.zeros(3), robot)]
    match = gs.match_scan(*scans, scanner, (0.1, 0.0, 0.2), backend="numpy")
    np.testing.assert_allclose(match.pose, robot, atol=3e-3)
    assert np.linalg.eigvalsh(match.covariance).min() > 0


def test_covariance_is_that_of_the_errors():
    """The mean normalised squared error of 150 noisy pairs of a room is near its expectation, 3."""
    rng = np.random.default_rng(4)
    first, second, truth = random_pairs(150, RING, seed=5)
    first, second = (scan + rng.normal(0, 0.01, scan.shape) for scan in (first, second))
    match = gs.match_scan(first, second, RING, truth, backend="opencl", method="icp")
    error = match.pose - truth
    squared = np.einsum("si,sij,sj->s", error, np.linalg.inv(match.covariance), error) / 3
    # Corners and occlusions add to the errors of noise.
    assert 0.6 < np.median(squared) / 0.79 < 1.8


def successive(rng: np.random.Generator, shape: tuple[int, int], rho: float) -> np.ndarray:
    """Return rows of numbers of unit variance; neighbours have the correlation rho."""
    noise = rng.normal(size=shape)
    for k in range(1, shape[1]):
        noise[:, k] = rho * noise[:, k - 1] + math.sqrt(1 - rho * rho) * noise[:, k]
    return noise


@pytest.mark.parametrize("rho", [0.0, 0.8, 0.95])
def test_covariance_is_that_of_correlated_errors(rho):
    """Errors of 1 cm that repeat from beam to beam: the covariance is the scatter of 150 estimates."""
    rng = np.random.default_rng(7)
    scanner = gs.Scanner.uniform(angle_min=-np.pi, angle_increment=np.pi / 360, count=720, range_max=30.0)
    truth = np.array([0.1, 0.05, 0.03])
    first, second = (segments_scan(ROOM, pose, scanner) for pose in ((0.0, 0.0, 0.0), tuple(truth)))
    first = first + 0.01 * rng.normal(size=(150, 720))
    match = gs.match_scan(first, second + 0.01 * successive(rng, (150, 720), rho), scanner, truth, backend="opencl")
    error = match.pose - truth
    squared = np.einsum("si,sij,sj->s", error, np.linalg.inv(match.covariance), error) / 3
    # The mean of 150 has a deviation of 0.07. The heading is a sum of errors of both signs along a wall, so correlation
    # adds less to its variance than to the positions'. Covariances of independent errors would make it 1.5, 6.6 and
    # 23.
    assert 0.6 < squared.mean() < 1.5
    scatter = np.cov(error.T)[:2, :2]
    np.testing.assert_allclose(np.trace(match.covariance.mean(axis=0)[:2, :2]) / np.trace(scatter), 1.0, atol=0.4)


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9])
def test_blocks_tell_the_inflation_of_the_variance(rho):
    """It is (1 + rho) / (1 - rho) for a correlation of rho^k over k points."""
    numbers = successive(np.random.default_rng(0), (1000, 500), rho)
    squares = np.mean([block_squares(row) for row in numbers], axis=0)
    assert inflation_of(squares.tolist()) == pytest.approx((1 + rho) / (1 - rho), rel=0.1)


def test_inflations_are_at_least_1():
    alternating, nothing = block_squares(np.array([1.0, -1.0] * 100)), np.zeros(8)
    assert inflation_of(np.stack([alternating, nothing], axis=1)).tolist() == [1, 1]


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("turn", [0.0, 0.5])
def test_a_corridor_says_that_its_axis_is_not_observed(noise, turn):
    rng = np.random.default_rng(1)
    scans = [segments_scan(CORRIDOR, pose, RING) for pose in ((0.0, 0.0, -turn), (0.3, 0.05, 0.05 - turn))]
    scans = [scan + rng.normal(0, noise, scan.shape) for scan in scans]
    match = gs.match_scan(*scans, RING, (0.2 * math.cos(turn), 0.2 * math.sin(turn), 0.0), backend="numpy")
    assert match.status == "unobservable"
    axis = match.directions[0]
    assert abs(axis[0] * math.cos(turn) + axis[1] * math.sin(turn)) > 0.99
    assert np.isinf(match.covariance[0, 0])
    assert match.eigenvalues[0] < 0.02 < match.eigenvalues[1]
    # Heading is observed.
    assert match.pose[2] == pytest.approx(0.05, abs=0.01)
    assert match.covariance[2, 2] < 1e-3


@pytest.mark.parametrize(
    ("first", "second", "statuses"),
    [
        (WALL, WALL, {"unobservable"}),
        (np.zeros((0, 4)), ROOM, {"few points", "no overlap"}),
        (ROOM, np.zeros((0, 4)), {"few points", "no overlap"}),
        (ROOM, ROOM + 60.0, {"few points", "no overlap"}),
    ],
    ids=["wall", "empty reference", "empty scan", "no overlap"],
)
def test_what_is_not_known_has_an_infinite_covariance(backend, first, second, statuses):
    pose = (0.0, 0.0, 0.0)
    scans = segments_scan(first, pose, FRONT), segments_scan(second, pose, FRONT)
    match = gs.match_scan(*scans, FRONT, backend=backend)
    assert match.status in statuses
    assert np.isinf(match.covariance.diagonal()).any()
    assert not match.converged
    assert match.usable == (match.status == "unobservable")
    assert not np.isnan(match.covariance).any()


def test_three_beams_are_too_few():
    scanner = gs.Scanner([-0.5, 0.0, 0.5], range_max=30.0)
    scans = [segments_scan(ROOM, pose, scanner) for pose in ((0.0, 0.0, 0.0), (0.1, 0.0, 0.0))]
    match = gs.match_scan(*scans, scanner, backend="numpy")
    assert match.status == "few points"
    assert not match.converged
    assert np.isinf(match.covariance.diagonal()).all()


def test_identical_scans_do_not_move():
    scan = segments_scan(ROOM, (0.0, 0.0, 0.4), FRONT)
    match = gs.match_scan(scan, scan, FRONT, backend="numpy")
    assert match.status == "converged"
    # At corners lines do not pass through their points.
    np.testing.assert_allclose(match.pose, 0, atol=1e-3)
    assert match.score == pytest.approx(1, abs=1e-2)


def test_a_symmetrical_room_stays_near_its_guess():
    scans = [segments_scan(SQUARE, pose, RING) for pose in ((0.0, 0.0, 0.0), (0.1, 0.0, 0.1))]
    match = gs.match_scan(*scans, RING, (0.0, 0.0, math.pi / 2), backend="numpy")
    np.testing.assert_allclose(match.pose[2], math.pi / 2 + 0.1, atol=2e-3)


def test_a_temperature_divides_the_covariance():
    scans = [segments_scan(ROOM, pose, RING) for pose in ((0.0, 0.0, 0.0), (0.1, 0.0, 0.1))]
    one, tenth = (gs.match_scan(*scans, RING, backend="numpy", temperature=value) for value in (1.0, 0.1))
    np.testing.assert_allclose(tenth.covariance, 10 * one.covariance)
    np.testing.assert_array_equal(tenth.pose, one.pose)


def test_what_the_reference_did_not_see_neither_attracts_nor_repels():
    """A scan of 181 beams is matched to the part of it that the other scan sees."""
    first, second = (segments_scan(ROOM, pose, FRONT) for pose in ((0.0, 0.0, 0.0), (0.1, 0.1, 0.6)))
    match = gs.match_scan(first, second, FRONT, (0.0, 0.0, 0.5), backend="numpy")
    np.testing.assert_allclose(match.pose, (0.1, 0.1, 0.6), atol=5e-3)


def test_no_scans_give_no_matches():
    match = gs.match_scan(np.ones((0, 360)), np.ones((0, 360)), RING, backend="numpy")
    assert len(match) == 0
    assert match.pose.shape == (0, 3)
