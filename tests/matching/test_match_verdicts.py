"""Verdicts of matches: lost directions, windows, noise, and probabilities."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from support.matching_scenes import FRONT, RING, WALL, box, random_pairs, segments_scan

import gpusense as gs
from gpusense.matching.columns import matrices_of, triangle_of
from gpusense.matching.observability import covariance_of, critical_ratio, observed_information
from gpusense.matching.points import ROOT, scan_noise
from gpusense.matching.result import STATUSES
from gpusense.matching.verdicts import NAMES

# A corridor longer than the scanners' range, and a room unlike ROOM everywhere.
CORRIDOR = np.array([[-200.0, -1.2, 200.0, -1.2], [-200.0, 1.4, 200.0, 1.4]])


def ring(beams: int, half: float = math.pi) -> gs.Scanner:
    return gs.Scanner.uniform(angle_min=-half, angle_increment=2 * half / beams, count=beams, range_max=30.0)


def corridor_pairs(scanner: gs.Scanner, noise: float, heading: float, count: int):
    """Return scans of a corridor, the true poses, and guesses 0.3 m off along it."""
    rng = np.random.default_rng(3)
    first = np.column_stack([np.zeros(count), rng.uniform(-0.4, 0.4, count), np.full(count, heading)])
    second = first + rng.uniform(-1, 1, (count, 3)) * (0.3, 0.1, 0.1)
    scans = [np.array([segments_scan(CORRIDOR, tuple(p), scanner) for p in poses]) for poses in (first, second)]
    one, two = (z + noise * rng.normal(size=z.shape) for z in scans)
    truth = gs.pose_difference(first, second)
    return one, two, truth, truth + 0.3 * np.array([math.cos(heading), -math.sin(heading), 0.0])


@pytest.mark.parametrize("beams", [360, 1081])
@pytest.mark.parametrize("noise", [0.01, 0.03, 0.05])
@pytest.mark.parametrize("heading", [0.0, 0.015, 0.3])
def test_corridors_never_converge_and_every_finite_deviation_is_right(beams, noise, heading):
    one, two, truth, guess = corridor_pairs(ring(beams, 0.75 * math.pi), noise, heading, 40)
    match = gs.match_scan(one, two, ring(beams, 0.75 * math.pi), guess, backend="opencl")
    assert not match.converged.any()
    assert match.usable.mean() > 0.95
    seen = match.usable
    off, variance = (match.pose - truth)[seen], np.einsum("sii->si", match.covariance)[seen]
    # The position along the corridor; also across it, unless the corridor follows an axis.
    assert np.isinf(variance[:, 0]).all()
    assert np.isinf(variance[:, 1]).all() or heading < 0.1
    assert np.isfinite(variance[:, 2]).all()
    assert (np.abs(off) < 5 * np.sqrt(variance)).all()


def circle_scan(pose: np.ndarray, scanner: gs.Scanner) -> np.ndarray:
    """Return ranges to a circle of 4 m about the origin."""
    angle = scanner.bearings + pose[2]
    along = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ pose[:2]
    return -along + np.sqrt(along**2 - pose[:2] @ pose[:2] + 16.0)


@pytest.mark.parametrize("beams", [360, 1081])
def test_a_circle_seen_off_its_centre_loses_every_coordinate(beams):
    scanner, rng = ring(beams), np.random.default_rng(0)
    move = np.array([0.1, -0.15, 0.05])
    scans = [circle_scan(np.array([1.5, 0.3, 0.0]) + off, scanner) for off in (np.zeros(3), move)]
    scans = [scan + rng.normal(0, 0.01, scan.shape) for scan in scans]
    match = gs.match_scan(*scans, scanner, move + np.array([0.02, 0.02, 0.15]), backend="opencl")
    assert match.status == "unobservable"
    assert np.isinf(match.covariance.diagonal()).all()
    # A turn about the circle's centre, at (-1.5, -0.3) in the first frame, changes nothing.
    lost = np.array([-(match.pose[1] + 0.3), match.pose[0] + 1.5, 1.0])
    assert np.abs(match.information @ lost).max() < 0.02 * np.abs(match.information).max()


def test_information_is_the_inverse_of_the_covariance_and_zero_along_what_is_lost(backend):
    one, two, truth = random_pairs(3, RING, seed=2)
    match = gs.match_scan(one, two, RING, truth, backend=backend)
    assert match.converged.all()
    np.testing.assert_allclose(match.information @ match.covariance, np.tile(np.eye(3), (3, 1, 1)), atol=1e-6)
    wall = segments_scan(WALL, (0.0, 0.0, 0.7), FRONT)
    found = gs.match_scan(wall, wall, FRONT, backend=backend)
    along = np.array([math.cos(-0.7), math.sin(-0.7), 0.0])
    assert found.status == "unobservable"
    assert np.abs(found.information @ along).max() < 1e-3 * np.abs(found.information).max()
    failed = gs.match_scan(wall, np.full(181, np.inf), FRONT, backend=backend)
    assert not failed.usable and (failed.information == 0).all() and failed.p_right == 0


def test_only_the_status_converged_is_converged():
    one, two, truth = random_pairs(4, RING, seed=9)
    match = gs.match_scan(one, two, RING, truth, backend="numpy")
    assert (match.converged == (match.status == "converged")).all()
    for status in STATUSES:
        assert bool(dataclasses.replace(match[0], status=status).converged) == (status == "converged")


def test_a_pose_outside_the_window_is_no_match(backend):
    one, two, truth = random_pairs(1, RING, seed=4)
    guess = truth + np.array([0.3, 0.0, 0.0])
    inside = gs.match_scan(one, two, RING, guess, backend=backend, window=(0.5, 0.5))
    outside = gs.match_scan(one, two, RING, guess, backend=backend, window=(0.2, 0.5))
    turned = gs.match_scan(one, two, RING, truth + np.array([0.0, 0.0, 0.2]), backend=backend, window=(0.5, 0.1))
    assert inside.status[0] == "converged"
    for match in (outside, turned):
        assert match.status[0] not in ("converged", "unobservable", "ambiguous")
        assert np.isinf(match.covariance[0].diagonal()).all()
        assert match.p_right[0] == 0 and (match.information == 0).all()


@pytest.mark.parametrize("noise", [0.006, 0.02, 0.05])
def test_the_noise_of_scans_is_found(noise):
    rng = np.random.default_rng(0)
    one, _, _ = random_pairs(20, RING, seed=6)
    found = scan_noise(one + noise * rng.normal(size=one.shape), RING)
    assert np.median(found) == pytest.approx(noise, rel=0.15)
    assert (np.abs(found - noise) < 0.4 * noise).all()


def test_steps_of_ranges_are_noise():
    one, _, _ = random_pairs(5, RING, seed=6)
    assert (scan_noise(np.round(one / 0.05) * 0.05, RING) >= 0.05 / math.sqrt(12) - 1e-9).all()
    assert (scan_noise(one, RING) < 1e-3).all()
    assert np.isnan(scan_noise(np.full((1, 360), np.inf), RING)).all()


@pytest.mark.long
def test_noise_of_a_call_does_not_depend_on_its_other_scans():
    rng = np.random.default_rng(1)
    one, two, truth = random_pairs(6, RING, seed=12)
    noise = np.repeat([0.005, 0.03], 3)[:, None]
    one, two = (z + noise * rng.normal(size=z.shape) for z in (one, two))
    match = gs.match_scan(one, two, RING, truth, backend="numpy")
    assert len(np.unique(match.noise)) > 1
    assert (np.abs(np.log(match.noise / noise[:, 0])) < 2 * math.log(ROOT)).all()
    # Several scans with one reference; some guesses need a search.
    guess = truth + [[0.0, 0.0, 0.0], [0.9, 0.3, 0.5]] * 3
    shared = gs.match_scan(one[0], two, RING, guess, backend="numpy")
    assert len(np.unique(shared.noise)) > 1
    for i in (0, 1, 4, 5):
        for k, (whole, start) in ((i, (match, truth)), (0, (shared, guess))):
            alone = gs.match_scan(one[k], two[i], RING, start[i], backend="numpy")
            assert alone.pose.tolist() == whole.pose[i].tolist()
            assert alone.information.tolist() == whole.information[i].tolist()
            assert float(alone.noise) == whole.noise[i] and alone.status == whole.status[i]
    fixed = gs.match_scan(one, two, RING, truth, backend="numpy", noise=0.02)
    assert (fixed.noise == 0.02).all()
    with pytest.raises((TypeError, ValueError), match=r"^noise"):
        gs.match_scan(one, two, RING, truth, backend="numpy", noise="loud")


def test_unrelated_rooms_do_not_converge_and_neighbours_do():
    rng = np.random.default_rng(5)
    one, two, truth = random_pairs(60, RING, seed=21)
    other = np.array([*box(-2.2, -5.0, 3.1, 3.7), *box(-0.6, 1.9, 0.8, 2.5), [1.0, -3.0, 3.1, -2.0]])
    poses = np.column_stack([rng.uniform(-0.5, 0.5, (60, 2)), rng.uniform(-3, 3, 60)])
    far = np.array([segments_scan(other, tuple(pose), RING) for pose in poses])
    one, two, far = (z + rng.normal(0, 0.01, z.shape) for z in (one, two, far))
    guess = truth + rng.uniform(-1, 1, truth.shape) * (0.3, 0.3, 0.1)
    near, unrelated = (gs.match_scan(one, z, RING, guess, backend="opencl") for z in (two, far))
    assert near.converged.mean() >= 0.97 and near.p_right.min() > 0.6
    assert not unrelated.converged.any()
    assert unrelated.p_right.max() < near.p_right.min()
    assert near.evidence.shape == (60, len(NAMES))


@pytest.mark.parametrize("beams", [8, 12, 36])
def test_few_beams_are_matched_to_a_map(beams):
    """Most poses of scans of a few beams over a full turn are found, with deviations that cover their errors."""
    grid, scanner, rng = gs.worlds.building(0), ring(beams), np.random.default_rng(0)
    rows, cols = np.nonzero(grid.free)
    chosen = rng.choice(len(rows), 40, replace=False)
    truth = np.column_stack([grid.cell_centers(rows[chosen], cols[chosen]), rng.uniform(-3, 3, 40)])
    exact = gs.RayCaster(grid, 30.0, backend="opencl").cast(truth, scanner.bearings).astype(float)
    ranges = exact + rng.normal(0, 0.01, exact.shape)
    near = exact.min(axis=1) > 0.3
    guess = truth + rng.uniform(-1, 1, truth.shape) * (0.1, 0.1, 0.05)
    match = gs.match_scan(grid, ranges[near], scanner, guess[near], backend="opencl")
    assert match.usable.mean() > 0.9
    off = match.pose - truth[near]
    seen = match.usable
    squared = np.einsum("si,sij,sj->s", off, match.information, off)[seen]
    assert np.median(squared / np.maximum((match.eigenvalues[seen] > 0).sum(axis=1), 1)) < 2
    if beams == 36:
        assert match.converged.mean() > 0.7
        assert np.median(np.hypot(off[:, 0], off[:, 1])) < 0.02


def test_covariances_of_noisy_dense_scans_are_right():
    """Noise turns short lines; with longer ones for pose and information, NEES / 3 is near 1."""
    rng, scanner = np.random.default_rng(4), ring(1081, 2.36)
    one, two, truth = random_pairs(100, scanner, seed=5)
    one, two = (z + rng.normal(0, 0.03, z.shape) for z in (one, two))
    match = gs.match_scan(one, two, scanner, truth, backend="opencl")
    off = (match.pose - truth)[match.converged]
    assert match.converged.mean() > 0.95
    squared = np.einsum("si,sij,sj->s", off, match.information[match.converged], off) / 3
    assert 0.6 < squared.mean() < 1.5


def test_observability_is_invariant_and_lost_wholly():
    """A direction with no more information than from noise is lost in all its coordinates."""
    lost = np.array([0.3, -1.5, 1.0])
    frame = np.linalg.qr(np.column_stack([lost, np.eye(3)[:, :2]]))[0]
    spurious = 2.0 * np.outer(frame[:, 0], frame[:, 0])[None]
    total = (frame @ np.diag([2.4, 300.0, 200.0]) @ frame.T)[None]
    found = observed_information(triangle_of(total), triangle_of(spurious), 1.0, 30.0, 1.5)
    information = matrices_of(found.information)
    assert found.lost == 1
    assert observed_information(triangle_of(total), triangle_of(spurious), 1.0, 30.0, 1.5, unneeded=True).lost == 1
    assert np.abs(information[0] @ lost).max() < 1e-9
    assert np.isinf(np.diagonal(covariance_of(information, 1.0, (1.0, 1.0))[0])).all()
    strong = observed_information(triangle_of(10 * total), triangle_of(spurious), 1.0, 30.0, 1.5)
    assert strong.lost == 0
    # An observed information loses only the part from noise.
    expected = 10 * total - spurious - 1e-3 * np.eye(3)
    np.testing.assert_allclose(matrices_of(strong.information), expected, rtol=1e-12)


def test_the_false_alarms_of_a_lost_direction_are_as_stated():
    """The critical ratio is the quantile of a chi-squared variable over its degrees of freedom."""
    rng = np.random.default_rng(0)
    for lines in (5, 20, 80):
        drawn = rng.chisquare(lines, 400_000) / lines
        assert (drawn > critical_ratio(np.array([float(lines)]))[0]).mean() <= 2e-4
