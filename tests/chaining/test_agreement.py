"""Agreement of place matches: single matches, groups, evidence, and breaks joined by closures."""

from __future__ import annotations

import numpy as np
import pytest
from support.matching_scenes import CORRIDOR, segments_scan, table_legs
from support.selection import present

import gpusense as gs
from gpusense.chaining.closing import joined_breaks
from gpusense.chaining.links import CLOSURE, Links
from gpusense.chaining.matcher import SURE, ChainOptions, Matcher
from gpusense.chaining.place_recognition import EVIDENCE, EVIDENCE_OVER_WEAK, agreeing
from gpusense.world.pose_algebra import compose_poses, pose_difference

FRONT = gs.Scanner.uniform(angle_min=-np.pi / 2, angle_increment=np.pi / 180, count=181, range_max=12.0)
MOVED = np.array([0.6, 0.1, 0.3])


def log(scenes: list[np.ndarray]) -> np.ndarray:
    """Return noisy scans of scenes, first all before and then all after a motion."""
    scans = [segments_scan(walls, tuple(pose), FRONT) for pose in (np.zeros(3), MOVED) for walls in scenes]
    return np.array(scans) + np.random.default_rng(0).normal(0, 0.01, (2 * len(scenes), FRONT.count))


@pytest.mark.parametrize("scene", ["furniture", "corridor"])
def test_directions_that_few_pairs_observe_are_taken_among_furniture_alone(scene):
    shifts = np.linspace(-0.3, 0.3, 12)[:, None] * (0, 1, 0, 1)
    scenes = [table_legs(seed) for seed in range(12)] if scene == "furniture" else [CORRIDOR + s for s in shifts]
    options = ChainOptions((0, 0), 0.0, None, False, present("opencl"), "float32")
    matcher, first = Matcher(log(scenes), FRONT, options), np.arange(12)
    found = matcher.match(first, first + 12, np.tile(MOVED, (12, 1)))
    lost = (found.eigenvalues == 0) & (found.usable & (found.p_right >= SURE))[:, None]
    taken = matcher.observed(first, first + 12, found)
    more = (taken.eigenvalues > 0) & (found.eigenvalues == 0)
    rows = more.any(axis=1)
    assert np.count_nonzero(lost.any(axis=1)) >= 8
    assert (np.count_nonzero(rows) >= 5) if scene == "furniture" else not rows.any()
    assert (more == lost)[rows].all() and not (more & ~lost).any()
    # Each of these directions gets a deviation of 4 cm before the temperature; other directions are unchanged.
    axes = found.directions * np.stack([np.ones(12), np.ones(12), 1 / found.lever], axis=1)[:, None]
    gained = np.einsum("lki,lij,lmj->lkm", axes, taken.information - found.information, axes)
    np.testing.assert_allclose(gained, np.eye(3) * more[:, :, None] / 0.04**2, rtol=1e-6, atol=1e-3)
    assert taken.pose is found.pose and (taken.information[~rows] == found.information[~rows]).all()


COUNT = 12


def passages(right: list[float], off: tuple[float, ...] = (2.0, -1.0, 0.2)) -> tuple[np.ndarray, Links]:
    """Return poses of two passages, the second with drift, and matches of equal places with p_right."""
    one = np.stack([0.8 * np.arange(COUNT), 0.05 * np.arange(COUNT), 0.02 * np.arange(COUNT)], axis=1)
    poses = np.concatenate([one, compose_poses(np.array(off), one)])
    at = np.arange(len(right))
    pose = pose_difference(one[at], one[at + 1])
    return poses, Links.of(CLOSURE, at, at + 1 + COUNT, pose, np.tile(1e3 * np.eye(3), (len(at), 1, 1)), right)


def test_two_matches_do_not_suffice_and_a_wrong_one_is_left_out() -> None:
    poses, links = passages([0.95, 0.95])
    assert not agreeing(links, poses, np.zeros(2)).any()
    poses, links = passages([0.95] * 5)
    links.pose[3] += (1.0, 0.0, 0.2)
    assert agreeing(links, poses, np.zeros(5)).tolist() == [True, True, True, False, True]
    assert not len(agreeing(links[:0], poses, np.zeros(0)))


@pytest.mark.parametrize(("right", "taken"), [([0.9] * 6, False), ([0.9] * 7, True), ([0.99] * 4, True)])
def test_where_the_drift_tells_nothing_a_group_needs_evidence(right: list[float], taken: bool) -> None:
    poses, links = passages(right)
    assert agreeing(links, poses, np.zeros(len(right))).all()
    assert agreeing(links, poses, np.full(len(right), EVIDENCE)).tolist() == [taken] * len(right)
    evidence = -np.log10(1 - np.array(right)).sum()
    for needed, enough in ((evidence - 1e-9, True), (evidence + 1e-9, False)):
        assert agreeing(links, poses, np.full(len(right), needed)).tolist() == [enough] * len(right)
    # Weak steps need less evidence.
    weak = np.full(len(right), EVIDENCE_OVER_WEAK)
    assert agreeing(links, poses, weak).all()
    assert agreeing(links[:4], poses, weak[:4]).tolist() == [right[0] > 0.9] * 4
    # Matches that need no evidence are none for other matches.
    mixed = np.where(np.arange(len(right)) < 2, EVIDENCE, 0.0)
    assert agreeing(links, poses, mixed).tolist() == [False] * 2 + [len(right) > 4] * (len(right) - 2)


def test_matches_of_one_scan_are_no_group() -> None:
    poses, links = passages([0.999] * 6)
    one = Links.of(CLOSURE, np.zeros(6, int), links.second, pose_difference(poses[:1], compose_poses(
        np.array([-2.0, 1.0, 0.0]), poses[links.second])), links.information, links.p_right)  # fmt: skip
    assert agreeing(one, poses, np.zeros(6)).all()
    assert not agreeing(one, poses, np.full(6, EVIDENCE)).any()


def test_closures_join_the_sides_of_breaks() -> None:
    broken = np.array([0, 0, 1, 1, 2, 3, 3])
    links = Links.of(CLOSURE, [1, 2], [5, 3], np.zeros((2, 3)), np.tile(np.eye(3), (2, 1, 1)), 1.0)
    assert joined_breaks(broken, links).tolist() == [0, 0, 1, 1, 2, 0, 0]
    assert joined_breaks(broken, links[:0]).tolist() == broken.tolist()
