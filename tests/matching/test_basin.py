"""Starts on both sides of a match distinguish few pairs among furniture from none along a corridor."""

from __future__ import annotations

import numpy as np
import pytest
from support.matching_scenes import CORRIDOR, segments_scan, table_legs
from support.selection import present

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.matching import icp_with_search

FRONT = gs.Scanner.uniform(angle_min=-np.pi / 2, angle_increment=np.pi / 180, count=181, range_max=12.0)
MOUNTED = gs.Scanner(FRONT.bearings, FRONT.range_max, mount=(0.4, -0.2, 0.3))


def seen(walls: np.ndarray, pose: np.ndarray, scanner: gs.Scanner, during: np.ndarray | None) -> np.ndarray:
    """Return the readings of a moving robot at a pose at the first beam."""
    if during is None:
        return segments_scan(walls, tuple(gs.compose_poses(pose, np.array(scanner.mount))), scanner)
    shares = np.linspace(0, 1, scanner.count)
    places = gs.compose_poses(gs.compose_poses(pose, np.outer(shares, during)), np.array(scanner.mount))
    beams = [gs.Scanner([bearing], scanner.range_max) for bearing in scanner.bearings]
    return np.concatenate([segments_scan(walls, tuple(p), beam) for p, beam in zip(places, beams, strict=True)])


def pairs(
    scenes: list[np.ndarray], moved: np.ndarray, scanner: gs.Scanner, during: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return noisy scans of each scene before and after a motion of the robot."""
    rng = np.random.default_rng(0)
    scans = [np.array([seen(walls, pose, scanner, during) for walls in scenes]) for pose in (np.zeros(3), moved)]
    one, two = (z + rng.normal(0, 0.01, z.shape) for z in scans)
    return one, two


def lost_and_held(
    one: np.ndarray, two: np.ndarray, scanner: gs.Scanner, guess: np.ndarray, during: np.ndarray | None = None
) -> tuple[np.ndarray, gs.ScanMatch, np.ndarray]:
    """Return the matches that lose a direction, with their numbers, and whether each is held."""
    device = present("opencl")
    moved = None if during is None else np.tile(during, (len(one), 1))
    match = gs.match_scan(
        one, two, scanner, np.tile(guess, (len(one), 1)), backend=device, motion=moved, reference_motion=moved
    )
    rows = np.flatnonzero(match.usable & (match.eigenvalues == 0).any(axis=1))
    some, motions = match.ordered(rows), (None, None) if moved is None else (moved[rows], moved[rows])
    return (
        rows,
        some,
        icp_with_search.is_held(one[rows], two[rows], scanner, some, get_backend(device), "float32", motions),
    )


@pytest.mark.parametrize("scanner", [FRONT, MOUNTED], ids=["at the robot", "mounted"])
def test_matches_among_table_legs_are_held_and_right(scanner):
    moved = np.array([0.6, 0.1, 0.3])
    one, two = pairs([table_legs(seed) for seed in range(12)], moved, scanner)
    _, match, held = lost_and_held(one, two, scanner, moved + np.array([0.1, 0.1, 0.05]))
    assert len(match) >= 10
    assert held.sum() >= 0.7 * len(match)
    assert np.abs(match.pose[held] - moved).max() < 0.05


@pytest.mark.parametrize("turn", [0.0, 0.3, 0.8])
@pytest.mark.parametrize("length", [0.05, 0.8])
def test_no_match_in_a_corridor_is_held(turn, length):
    moved = np.array([length, 0.0, turn])
    shifts = np.linspace(-0.3, 0.3, 12)[:, None] * (0, 1, 0, 1)
    _, match, held = lost_and_held(*pairs([CORRIDOR + shift for shift in shifts], moved, FRONT), FRONT, moved)
    assert len(match) >= 8
    assert not held.any()


def test_motion_during_scans_counts():
    moved, during = np.array([0.6, 0.1, 0.3]), np.array([0.2, 0.0, 0.3])
    one, two = pairs([table_legs(seed) for seed in range(12)], moved, FRONT, during)
    _, match, held = lost_and_held(one, two, FRONT, moved, during)
    assert len(match) >= 10
    assert held.sum() >= 0.7 * len(match)
    assert np.abs(match.pose[held] - moved).max() < 0.05
    # Ignoring the motion distorts the scans' shapes and the poses.
    _, other, _ = lost_and_held(one, two, FRONT, moved)
    assert np.abs(other.pose - moved).max() > 0.05


def test_recorded_matches_that_are_held_are_right(data_dir):
    """In corridors of aces doors look alike: without the exchanged scans two matches a metre off would be held."""
    scans = list(gs.read_log(data_dir / "carmen_logs/aces-corrected.log.gz"))
    ranges, truth = np.array([scan.ranges for scan in scans]), np.array([scan.pose for scan in scans])
    moved = gs.pose_difference(truth[:-1], truth[1:])
    rows, match, held = lost_and_held(ranges[:-1], ranges[1:], scans[0].scanner, np.zeros(3))
    off = np.hypot(*(match.pose - moved[rows])[:, :2].T)
    assert held.sum() >= 5
    assert np.count_nonzero(off > 0.5) >= 10
    assert off[held].max() < 0.15


@pytest.mark.parametrize("noise", [0.002, 0.15])
def test_starts_have_the_noise_of_the_match(monkeypatch, noise):
    """A noise from the caller is neither rounded nor limited."""
    one, two = pairs([CORRIDOR, CORRIDOR], np.array([0.1, 0.0, 0.0]), FRONT)
    match = gs.match_scan(one, two, FRONT, backend="numpy", noise=noise)
    used: list[float] = []
    made = icp_with_search.IcpPairs
    monkeypatch.setattr(icp_with_search, "IcpPairs", lambda *given: (used.extend(given[4]), made(*given))[1])
    icp_with_search.is_held(one, two, FRONT, match, get_backend("numpy"), "float32")
    assert used == [noise] * 4


@pytest.mark.parametrize("first", [0, 2], ids=["there", "back"])
def test_a_start_that_ends_nowhere_is_not_held(monkeypatch, first):
    """A device may return NaN for a start whose equations have no solution."""
    one, two = pairs([CORRIDOR, CORRIDOR], np.array([0.1, 0.0, 0.0]), FRONT)
    match = gs.match_scan(one, two, FRONT, backend="numpy")
    run = icp_with_search.IcpPairs.run

    def broken(*arguments, **options):
        found = run(*arguments, **options)
        found[first : first + 2] = np.nan
        return found

    monkeypatch.setattr(icp_with_search.IcpPairs, "run", broken)
    assert not icp_with_search.is_held(one, two, FRONT, match, get_backend("numpy"), "float32").any()
