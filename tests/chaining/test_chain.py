"""Chains of scans: closed forms, loops, degenerate cases and bad input."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.chain_scenes import BLOCK, OTHER, around, drifting, errors, normalised_errors, scans_of, wrong_motions
from support.matching_scenes import CORRIDOR, FRONT, RING, ROOM
from support.selection import present

import gpusense as gs
from gpusense.chaining.chain import Chainer
from gpusense.chaining.matcher import motions_around
from gpusense.chaining.place_recognition import overlaps


@pytest.fixture(scope="module")
def lap() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return poses of slightly more than a lap, scans and odometry."""
    poses = around(0.5)
    return poses, scans_of(BLOCK, poses, FRONT), drifting(poses)


@pytest.fixture(scope="module")
def closed(lap: tuple[np.ndarray, ...]) -> gs.ScanChain:
    """Return the chain of the lap with its odometry."""
    return gs.chain_scans(lap[1], FRONT, lap[2], backend=present("opencl"))


def test_a_loop_is_closed_and_the_error_falls(lap: tuple[np.ndarray, ...], closed: gs.ScanChain, needs) -> None:
    truth, scans, odometry = lap
    chain = closed
    open_ = gs.chain_scans(scans, FRONT, odometry, close_loops=False, backend=needs("opencl"))
    assert np.allclose(chain.poses[0], odometry[0])
    assert len(chain.closures) >= 3
    assert len(open_.closures) == 0
    wheels = gs.pose_difference(odometry[0], odometry) - gs.pose_difference(truth[0], truth)
    assert np.hypot(*wheels[:, :2].T).max() > 3.0
    assert errors(chain, truth).max() < 0.15
    # Every closure is right.
    closures = chain.closures
    off = closures.pose - gs.pose_difference(truth[closures.first], truth[closures.second])
    assert np.abs(off[:, :2]).max() < 0.1
    assert (closures.p_right >= 0.9).all()
    # A closure determines the end of the lap, but not the far side.
    deviation = np.sqrt(np.trace(chain.covariance[:, :2, :2], axis1=1, axis2=2))
    assert deviation[0] == 0
    assert deviation[int(len(truth) / 1.1) - 1] < 0.7 * deviation.max()
    assert "closures" in chain.explain()


def test_errors_are_within_their_deviations(lap: tuple[np.ndarray, ...], closed: gs.ScanChain) -> None:
    assert np.median(normalised_errors(closed, lap[0])) < 2.0


def rounds(laps: int) -> np.ndarray:
    """Return poses of a robot that drives rounds in ROOM."""
    turns = np.arange(0, 2 * np.pi, np.pi / 10)
    return np.tile(np.stack([0.7 * np.sin(turns), -0.7 * np.cos(turns), turns], axis=1), (laps, 1))


def test_key_scans_links_and_bytes_grow_with_the_way(needs) -> None:
    found = []
    for laps in (2, 4):
        truth = rounds(laps)
        chain = gs.chain_scans(
            scans_of(ROOM, truth, FRONT), FRONT, drifting(truth, 1.02, 0.0), close_loops=False, backend=needs("opencl")
        )
        arrays = (chain.poses, chain.covariance, *vars(chain.links).values())
        found.append([len(chain.keys), chain.matched, len(chain.links), sum(array.nbytes for array in arrays)])
    assert (np.array(found[1]) / found[0] < 2.2).all(), found


@pytest.mark.parametrize("path", [around(1.0, laps=1.0), rounds(1)[::2]], ids=["corridors", "room"])
def test_passes_through_the_same_places_are_compared_with_a_few(path: np.ndarray) -> None:
    # The number of earlier passages grows, but not the number of comparisons per passage.
    walls = ROOM if len(path) == len(rounds(1)[::2]) else BLOCK
    points, compared = [end_points(scan) for scan in scans_of(walls, path, FRONT)], []
    for laps in (30, 60):
        ranks = np.arange(laps * len(path))
        first, second, share = overlaps(points * laps, np.tile(path, (laps, 1)), 1.0, 5, (0 * ranks, ranks))
        assert (share >= 0.3).all() and (second - first >= 5).all()
        each = np.bincount(second, minlength=len(ranks))
        assert each[-len(path) :].min() >= 3 and each.max() <= 8
        compared.append((len(first), int(first.max())))
    assert compared[1][0] < 2.25 * compared[0][0]
    assert compared[1][1] == compared[0][1]


def end_points(scan: np.ndarray) -> np.ndarray:
    """Return the end points (K, 2) of a scan."""
    return scan[:, None] * np.stack([np.cos(FRONT.bearings), np.sin(FRONT.bearings)], axis=1)


def test_each_backend_finds_the_same(backend: str) -> None:
    poses = np.array([(0.1 * k, 0.02 * k, 0.05 * k) for k in range(8)])
    chain = gs.chain_scans(scans_of(ROOM, poses, RING), RING, backend=backend)
    assert errors(chain, poses).max() < 0.02
    assert len(chain.doubts) == 0


def test_a_corridor_says_that_the_way_along_it_is_unknown(needs) -> None:
    poses = np.array([(0.3 * k, 0.0, 0.0) for k in range(40)])
    scans = scans_of(CORRIDOR, poses, RING)
    chain = gs.chain_scans(scans, RING, backend=needs("opencl"))
    assert {doubt.reason for doubt in chain.doubts} == {"unobserved"}
    assert chain.doubtful[1:].all()
    assert "do not observe" in chain.explain()
    along, across = chain.covariance[-1, 0, 0], chain.covariance[-1, 1, 1]
    assert np.sqrt(across) < 0.3
    # No less than the error.
    assert np.sqrt(along) > 0.3
    assert abs(chain.poses[-1, 1]) < 0.1
    assert np.abs(chain.poses[:, 2]).max() < 0.02


def test_odometry_fills_what_a_corridor_leaves_open(needs) -> None:
    poses = np.array([(0.3 * k, 0.0, 0.0) for k in range(40)])
    odometry = drifting(poses, 1.0, 0.02)
    chain = gs.chain_scans(scans_of(CORRIDOR, poses, RING), RING, odometry, backend=needs("opencl"))
    assert errors(chain, poses).max() < 0.15
    assert not chain.doubts
    assert np.abs(gs.pose_difference(chain.poses[0], chain.poses)[:, 2]).max() < 0.03


@pytest.mark.parametrize("with_odometry", [True, False])
def test_a_robot_at_rest_stays(with_odometry: bool, needs) -> None:
    poses = np.zeros((60, 3))
    odometry = poses if with_odometry else None
    chain = gs.chain_scans(scans_of(ROOM, poses, FRONT), FRONT, odometry, backend=needs("opencl"))
    assert np.abs(chain.poses).max() < 0.01
    assert chain.keys.tolist() == [0]
    assert chain.matched == (1 if with_odometry else 60)


def test_a_turn_that_the_odometer_missed_is_matched(needs) -> None:
    poses = np.zeros((6, 3))
    poses[3:, 2] = 1.2
    chain = gs.chain_scans(scans_of(ROOM, poses, RING), RING, np.zeros((6, 3)), backend=needs("opencl"))
    assert chain.poses[-1, 2] == pytest.approx(1.2, abs=0.02)


@pytest.mark.parametrize("odometry", [None, np.array([[1.0, 2.0, 3.0]])])
def test_one_scan_is_a_trajectory_of_one_pose(odometry: np.ndarray | None) -> None:
    chain = gs.chain_scans(scans_of(ROOM, np.zeros((1, 3)), FRONT), FRONT, odometry, backend="numpy")
    assert chain.poses == pytest.approx(np.zeros((1, 3)) if odometry is None else odometry)
    assert chain.covariance.tolist() == np.zeros((1, 3, 3)).tolist()
    assert len(chain.links) == 0


@pytest.mark.parametrize("with_odometry", [False, True])
def test_two_scans_are_a_trajectory(with_odometry: bool, needs) -> None:
    path = np.array([[-1.0, -0.6, 0.0], [-0.7, -0.6, 0.05]])
    moved = gs.pose_difference(path[:1], path[1:])
    odometry = np.concatenate([np.zeros((1, 3)), moved]) if with_odometry else None
    chain = gs.chain_scans(scans_of(ROOM, path, RING), RING, odometry, backend=needs("opencl"))
    np.testing.assert_allclose(chain.poses[1:], moved, atol=0.01)


def test_motions_around_the_only_good_one_are_rest() -> None:
    motion, last = np.arange(9.0).reshape(3, 3), np.full(3, 20.0)
    good = np.array([False, True, False])
    before, after, _ = motions_around(motion, good, None)
    assert before.tolist() == after.tolist() == [[3, 4, 5], [0, 0, 0], [3, 4, 5]]
    before, after, mean = motions_around(motion, good, last)
    assert before.tolist() == [[20] * 3, [20] * 3, [3, 4, 5]]
    assert after.tolist() == [[3, 4, 5], [20] * 3, [3, 4, 5]]
    assert mean[0].tolist() == [11.5, 12, 12.5]


@pytest.mark.parametrize("with_odometry", [True, False])
def test_scans_without_returns_are_bridged(with_odometry: bool, needs) -> None:
    poses = np.array([(0.1 * k, 0.0, 0.0) for k in range(12)])
    scans = scans_of(ROOM, poses, RING)
    scans[5:8] = np.inf
    chain = gs.chain_scans(scans, RING, poses if with_odometry else None, backend=needs("opencl"))
    assert ("no match" in [doubt.reason for doubt in chain.doubts]) and chain.doubtful[5:9].all()
    assert errors(chain, poses)[:5].max() < 0.02
    assert errors(chain, poses).max() < (0.05 if with_odometry else 0.15)
    nothing = gs.chain_scans(np.full((5, 360), np.inf), RING, backend=needs("opencl"))
    assert np.isfinite(nothing.poses).all()
    assert nothing.covariance[-1, 0, 0] > 0


def test_a_jump_of_time_is_said(needs) -> None:
    poses = np.array([(0.1 * k, 0.0, 0.0) for k in range(12)])
    times = 0.2 * np.arange(12.0)
    times[6:] += 100.0
    chain = gs.chain_scans(scans_of(ROOM, poses, RING), RING, times=times, backend=needs("opencl"))
    # The chain recognises the place.
    assert not chain.doubts
    assert errors(chain, poses).max() < 0.02
    scans = np.concatenate([scans_of(ROOM, poses[:6], RING), scans_of(BLOCK, poses[6:] + np.array([5, 1.2, 0]), RING)])
    chain = gs.chain_scans(scans, RING, times=times, backend=needs("opencl"))
    assert {"jump", "no match"} <= {d.reason for d in chain.doubts}
    assert np.sqrt(chain.covariance[-1, 0, 0]) > 10


@pytest.mark.parametrize(
    ("step", "range_max", "most"),
    [(0.8, 6.0, None), (1.3, 6.0, None), (1.0, 30.0, 0.3), (0.7, 10.0, 2.0), (1.0, 10.0, 5.0)],
)
def test_large_motions_without_odometry_are_found_or_doubtful(step, range_max, most, needs) -> None:
    # In a corridor, scans agree best for a robot at rest; quarter turns make further matches wrong.
    truth, short = around(step), gs.Scanner(FRONT.bearings, range_max=range_max)
    chain = gs.chain_scans(scans_of(BLOCK, truth, short), short, close_loops=False, backend=needs("opencl"))
    wrong = wrong_motions(chain, truth)
    assert chain.doubtful[1:][wrong].all()
    if most is None:
        assert wrong.any() and not chain.doubtful.all()
        return
    assert errors(chain, truth).max() < most
    assert "contested" in {doubt.reason for doubt in chain.doubts}
    assert "for a second motion" in chain.explain()


def test_a_failed_match_is_bridged_over(needs) -> None:
    # People block the scanner at one scan.
    truth = np.array([(0.25 * k - 1.2, 0.1 * k - 0.6, 0.12 * k) for k in range(10)])
    scans = scans_of(ROOM, truth, RING)
    rng = np.random.default_rng(3)
    scans[5] = np.where(rng.random(RING.count) < 0.75, rng.uniform(0.3, 1.2, RING.count), scans[5])
    chainer = Chainer(scans, RING, None, backend=needs("opencl"))
    list(chainer.steps())
    chain = chainer.chain()
    good = np.arange(10) != 5
    assert errors(chain, truth)[good].max() < 0.05
    assert chain.doubtful[5:7].all() and not chain.doubtful[:5].any() and not chain.doubtful[7:9].any()
    # Its neighbours are linked.
    assert ((chain.links.first <= 4) & (chain.links.second >= 6)).any()
    # Both steps may be breaks; so may a step with an unsure match, or with a single match after a jump in time.
    (front,) = chainer.fronts
    assert np.flatnonzero(front.weak).tolist() == [4, 5]
    front.p_right[7] = 0.6
    assert np.flatnonzero(front.weak).tolist() == [4, 5]
    front._parts = [front.links[front.links.second - front.links.first == 1]]
    front.jumps[2] = True
    assert np.flatnonzero(front.weak).tolist() == [1, 4, 5, 7]


@pytest.mark.parametrize("with_odometry", [True, False])
def test_joined_logs_of_two_buildings_are_not_closed(with_odometry: bool, lap: tuple[np.ndarray, ...], needs) -> None:
    truth, scans, _ = lap
    x = np.arange(0, 16, 0.4)
    ways = np.stack([x - 1.5, np.full(len(x), -1.3), np.zeros(len(x))], axis=1)
    odometry = drifting(np.concatenate([truth, ways]), 1.0, 0.002) if with_odometry else None
    joined, border = np.concatenate([scans, scans_of(OTHER, ways, FRONT, seed=1)]), len(scans)
    chain = gs.chain_scans(joined, FRONT, odometry, backend=needs("opencl"))
    links = chain.closures
    assert ((links.first < border) == (links.second < border)).all()
    assert (border - 1, border, "no match") in [tuple(doubt) for doubt in chain.doubts]
    # The lap in the first building is closed.
    assert len(links) >= 3
    off = gs.pose_difference(chain.poses[0], chain.poses[:border]) - gs.pose_difference(truth[0], truth)
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.3
    assert (chain.motion is None) != with_odometry


def test_a_run_that_is_interrupted_keeps_what_it_has(lap: tuple[np.ndarray, ...], needs, monkeypatch) -> None:
    truth, scans, odometry = lap
    monkeypatch.setattr("gpusense.chaining.front.GUIDED_GROUP", 40)
    chainer = Chainer(scans, FRONT, odometry, backend=needs("opencl"))
    steps = chainer.steps()
    assert len(chainer.chain().poses) == 1
    next(steps)
    next(steps)
    assert 70 < chainer.scans < len(scans)
    part = chainer.chain()
    assert len(part.poses) == chainer.scans
    assert errors(part, truth[: chainer.scans]).max() < 0.3
    for _ in steps:
        pass
    assert len(chainer.chain().poses) == len(scans)


def test_a_recorded_log_closes_its_loops_rightly(data_dir: Path, needs) -> None:
    scans = list(gs.read_log(data_dir / "carmen_logs/seattle-corrected.log.gz"))[:160]
    truth = np.array([scan.pose for scan in scans])
    chain = gs.chain_scans([s.ranges for s in scans], scans[0].scanner, truth, backend=needs("opencl"))
    closures = chain.closures
    off = closures.pose - gs.pose_difference(truth[closures.first], truth[closures.second])
    assert len(closures) > 100
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.5
