"""Chains of a robot with several lasers: one trajectory, loops between lasers, and places that one laser misses."""

from __future__ import annotations

import numpy as np
import pytest
from support.chain_scenes import BLOCK, around, drifting, errors, normalised_errors, scans_of
from support.matching_scenes import CORRIDOR, FRONT, ROOM
from support.selection import present

import gpusense as gs
from gpusense.chaining.chain import Chainer
from gpusense.chaining.links import Links

AHEAD = gs.Scanner(FRONT.bearings, FRONT.range_max, mount=(0.25, 0.0, 0.05))
BACK = gs.Scanner(FRONT.bearings, FRONT.range_max, mount=(-0.3, 0.1, np.pi))
# A laser unlike the others.
SIDE = gs.Scanner.uniform(angle_min=-2.0, angle_increment=0.02, count=201, range_max=12.0, mount=(0.0, 0.2, 0.7))


def seen(walls: np.ndarray, poses: np.ndarray, scanners: list[gs.Scanner]) -> tuple[list[np.ndarray], np.ndarray]:
    """Return scans of alternating lasers along a trajectory, and the laser of each."""
    sensor = np.arange(len(poses)) % len(scanners)
    scans = []
    for k, (pose, one) in enumerate(zip(poses, sensor, strict=True)):
        at = gs.compose_poses(pose, np.array(scanners[one].mount))
        plain = gs.Scanner(scanners[one].bearings, scanners[one].range_max)
        scans.append(scans_of(walls, at[None], plain, seed=k)[0])
    return scans, sensor


def wrong(links: Links, truth: np.ndarray) -> float:
    """Return the largest error of links along their observed directions [m, or rad at 5 m]."""
    off = gs.pose_difference(truth[links.first], truth[links.second])
    off = links.pose - off
    off[:, 2] = 5 * gs.wrap_angle(off[:, 2])
    scale = np.array([1.0, 1.0, 0.2])
    values, vectors = np.linalg.eigh(links.information * scale[:, None] * scale)
    along = np.einsum("lij,li->lj", vectors, off)
    return float(np.abs(along[values > 1e-6 * values[:, -1:]]).max())


@pytest.fixture(scope="module")
def lap() -> tuple[np.ndarray, list[np.ndarray], np.ndarray, np.ndarray]:
    """Return poses of slightly more than a lap, scans of two alternating lasers, the laser of each, and odometry."""
    poses = around(0.5)
    scans, sensor = seen(BLOCK, poses, [AHEAD, BACK])
    return poses, scans, sensor, drifting(poses)


@pytest.fixture(scope="module")
def chains(lap: tuple) -> dict[bool, gs.ScanChain]:
    """Return the chains of the lap with and without odometry."""
    truth, scans, sensor, odometry = lap
    options = {"sensor": sensor, "times": 0.2 * np.arange(len(truth)), "backend": present("opencl")}
    return {known: gs.chain_scans(scans, [AHEAD, BACK], odometry if known else None, **options)
            for known in (True, False)}  # fmt: skip


@pytest.mark.sampled(0.5)
@pytest.mark.parametrize("with_odometry", [True, False])
def test_lasers_in_turn_are_one_trajectory(lap: tuple, chains: dict, with_odometry: bool) -> None:
    (truth, _, sensor, _), chain = lap, chains[with_odometry]
    assert chain.poses.shape == truth.shape and chain.sensor.tolist() == sensor.tolist()
    assert errors(chain, truth).max() < 0.2
    # At first, without odometry, only one laser determines the motion.
    assert not chain.doubtful[3:-1].any()
    kinds = set(chain.links.kind.tolist())
    assert {"match", "coupling", "closure"} <= kinds and ("odometry" in kinds) == with_odometry
    # Matches link scans of a laser, couplings link scans of two lasers.
    lasers = sensor[chain.links.first] == sensor[chain.links.second]
    assert lasers[chain.links.kind == "match"].all() and not lasers[chain.links.kind == "coupling"].any()
    closures = chain.closures
    assert wrong(closures, truth) < 0.25
    assert {0, 1} <= set(sensor[closures.first].tolist())


def test_errors_of_two_lasers_are_within_their_deviations(lap: tuple, chains: dict) -> None:
    assert np.median(normalised_errors(chains[True], lap[0])) < 2.0


def test_a_laser_that_sees_nothing_is_bridged_by_the_other(needs) -> None:
    truth = around(0.3, laps=0.4)
    scans, sensor = seen(BLOCK, truth, [AHEAD, BACK])
    blind = [np.full(FRONT.count, np.inf) if one == 0 and 60 <= k < 84 else z
             for k, (one, z) in enumerate(zip(sensor, scans, strict=True))]  # fmt: skip
    options = {"close_loops": False, "backend": needs("opencl")}
    both = gs.chain_scans(blind, [AHEAD, BACK], sensor=sensor, **options)
    alone = gs.chain_scans(blind[::2], AHEAD, **options)
    assert alone.doubtful[30:42].all()
    assert errors(alone, truth[sensor == 0]).max() > 0.5
    assert "no match" not in [doubt.reason for doubt in both.doubts]
    assert errors(both, truth).max() < 0.15


def test_a_direction_that_one_laser_observes_is_no_doubt(needs) -> None:
    # In the corridor one laser sees a parallel wall, the other one also its end.
    end = np.array([[8.0, -1.2, 8.0, 1.4]])
    truth = np.array([(0.15 * k, 0.0, 0.0) for k in range(40)])
    wall = gs.Scanner(np.radians(np.arange(30, 151)), 30.0)
    scans, sensor = seen(np.concatenate([CORRIDOR, end]), truth, [FRONT, wall])
    one = gs.chain_scans(scans[1::2], wall, backend=needs("opencl"))
    assert one.doubtful[1:].all()
    both = gs.chain_scans(scans, [FRONT, wall], sensor=sensor, backend=needs("opencl"))
    # The link is only to the last scan, which shows the wall.
    assert both.doubtful.tolist() == [False] * 39 + [True]
    assert errors(both, truth).max() < 0.1
    assert np.sqrt(both.covariance[-2, 0, 0]) < 0.2


def test_loops_are_closed_between_lasers_in_front_and_rear(needs) -> None:
    # There and back, turned around: the front sees the rear's places.
    walls = BLOCK
    ahead = np.array([(x, 1.25, 0.0) for x in np.arange(2.0, 15.0, 0.35)])
    turn = np.array([(15.0, 1.25, t) for t in np.arange(0.15, np.pi, 0.15)])
    home = np.array([(x, 1.25, np.pi) for x in np.arange(15.0, 2.0, -0.35)])
    truth = np.concatenate([ahead, turn, home])
    scans, sensor = seen(walls, truth, [AHEAD, BACK])
    odometry = drifting(truth, 1.02, 0.01)
    chain = gs.chain_scans(scans, [AHEAD, BACK], odometry, sensor=sensor, backend=needs("opencl"))
    closures = chain.closures
    across = sensor[closures.first] != sensor[closures.second]
    assert across.sum() >= 3
    assert wrong(closures, truth) < 0.25
    assert errors(chain, truth).max() < 0.15


def test_lasers_of_different_geometry_start_and_end_apart(needs) -> None:
    truth = np.array([(1.2 * np.sin(0.05 * k) - 0.5, 0.8 * (1 - np.cos(0.05 * k)) - 0.5, 0.05 * k) for k in range(40)])
    scans, sensor = seen(ROOM, truth, [AHEAD, SIDE, BACK])
    keep = [k for k in range(40) if not (sensor[k] == 1 and k < 12) and not (sensor[k] == 2 and k > 25)]
    chain = gs.chain_scans(
        [scans[k] for k in keep], (AHEAD, SIDE, BACK), sensor=sensor[keep], times=np.array(keep) * 0.1,
        backend=needs("opencl"),
    )  # fmt: skip
    assert errors(chain, truth[keep]).max() < 0.05
    # Only one laser measures the last motion.
    assert not chain.doubtful[:-1].any()


def test_one_scanner_in_a_list_is_that_scanner(needs) -> None:
    poses = np.array([(0.1 * k, 0.02 * k, 0.05 * k) for k in range(8)])
    scans = scans_of(ROOM, poses, FRONT)
    one = gs.chain_scans(scans, FRONT, backend=needs("opencl"))
    listed = gs.chain_scans(scans, [FRONT], backend=needs("opencl"))
    np.testing.assert_array_equal(one.poses, listed.poses)
    np.testing.assert_array_equal(one.covariance, listed.covariance)


def test_motion_is_taken_out_of_scans_of_each_laser(needs) -> None:
    # Scans of 0.2 s of a robot that turns; the second laser lists its beams in reverse.
    back = gs.Scanner(BACK.bearings[::-1], BACK.range_max, mount=BACK.mount)
    duration, count = 0.2, FRONT.count

    def at(t: np.ndarray) -> np.ndarray:
        return np.stack([0.8 * np.sin(t) - 0.5, 0.8 * (1 - np.cos(t)) - 0.8, t], axis=-1)

    times, sensor, scans = 0.125 * np.arange(40), np.arange(40) % 2, []
    for t, one in zip(times, sensor, strict=True):
        scanner = (AHEAD, BACK)[one]
        poses = gs.compose_poses(at(t + duration * np.arange(count) / (count - 1)), np.array(scanner.mount))
        # The rear laser measures in the order of BACK, and lists the last beam first.
        z = np.array([scans_of(ROOM, pose[None], gs.Scanner([b], 30.0))[0, 0]
                      for pose, b in zip(poses, FRONT.bearings, strict=True)])  # fmt: skip
        scans.append(z if one == 0 else z[::-1])
    chain = gs.chain_scans(
        scans, [AHEAD, back], sensor=sensor, times=times, duration=[duration, duration], backend=needs("opencl")
    )
    assert chain.duration == (duration, -duration)
    assert chain.later.tolist() == (duration * sensor).tolist()
    truth = at(times + chain.later)
    assert errors(chain, truth)[3:-3].max() < 0.06
    assert "scanner 1: scans of 0.2 s, measured in reverse" in chain.explain()
    assert chain.motions is not None and np.abs(np.abs(chain.motions[4:-4, 2]) - duration).max() < 0.03


def test_an_interrupt_keeps_the_scans_of_all_lasers_so_far(lap: tuple, needs, monkeypatch) -> None:
    truth, scans, sensor, odometry = lap
    monkeypatch.setattr("gpusense.chaining.front.GUIDED_GROUP", 20)
    chainer = Chainer(scans, [AHEAD, BACK], odometry, sensor=sensor, backend=needs("opencl"))
    steps = chainer.steps()
    assert len(chainer.chain().poses) == 1
    for _ in range(5):
        next(steps)
    part = chainer.chain()
    assert 70 < len(part.poses) == chainer.scans < len(scans)
    assert errors(part, truth[: chainer.scans]).max() < 0.3


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sensor": None}, "sensor: must say which of the 2 scanners each scan is of, got None"),
        ({"sensor": [0, 2]}, r"sensor: every index must be in \[0, 2\), got 2 at index 1"),
        ({"sensor": [0, -1]}, r"sensor: every index must be in \[0, 2\), got -1 at index 1"),
        ({"sensor": [0, 0]}, "sensor: every scanner must have a scan, got none of scanner 1"),
        ({"scanner": FRONT}, "sensor: must be None with a single scanner"),
        (
            {"scans": [np.ones(181), np.ones(7)]},
            "scans: scan 1 must have the 181 readings of scanner 1, got shape .7,.",
        ),
        ({"duration": [0.0, 0.1]}, "duration: must be 0 without times"),
    ],
)
def test_bad_values(changes: dict, message: str) -> None:
    arguments = {"scans": [np.ones(181), np.ones(181)], "scanner": [AHEAD, BACK], "sensor": [0, 1]} | changes
    with pytest.raises(ValueError, match=message):
        gs.chain_scans(arguments.pop("scans"), arguments.pop("scanner"), backend="numpy", **arguments)
