"""Features of scans that are turned, mirrored, or have beams in another order."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.feature_scenes import floor_plan

import gpusense as gs

KINDS = ("line", "corner", "door", "hallway", "pole")


def bearings_of(beams: int) -> np.ndarray:
    """Return bearings over a full turn, or over three quarters for an odd number."""
    if beams % 2:
        return np.linspace(-0.75 * math.pi, 0.75 * math.pi, beams)
    return 2 * math.pi / beams * np.arange(beams) - math.pi


def scans_of(seed: int, bearings: np.ndarray, noise: float, count: int) -> np.ndarray:
    floor = floor_plan(seed)
    exact, _ = floor.cast(floor.poses(count, seed), bearings)
    rng = np.random.default_rng([seed, 3])
    ranges = exact + noise * rng.standard_normal(exact.shape)
    # Missing readings leave gaps of one to five beams.
    first = rng.integers(0, len(bearings) - 5, 3)
    for k in range(1, 6):
        ranges[k % count, first[k % 3] : first[k % 3] + k] = np.nan
    return ranges


def assert_same(found: gs.Features, first: gs.Features, turn: float = 0.0, mirror: bool = False) -> None:
    """Compare features with features mirrored at the x axis and then turned, in any order."""
    side = -1.0 if mirror else 1.0
    c, s = math.cos(turn), math.sin(turn)
    xy = first.pose[:, :2] * (1, side) @ np.array([[c, s], [-s, c]])
    theta = side * first.pose[:, 2] + turn
    for kind in KINDS:
        one, two = np.flatnonzero(first.kind == kind), np.flatnonzero(found.kind == kind)
        assert len(one) == len(two), kind
        if not len(one):
            continue
        off = np.linalg.norm(xy[one, None] - found.pose[two, :2], axis=2)
        off += np.abs(first.size[one, None] - found.size[two])
        if kind != "pole":
            # Walls, doors and axes have no sense of direction under reflections.
            off += np.abs(np.sin(theta[one, None] - found.pose[two, 2]))
        off[first.scan[one, None] != found.scan[two]] = np.inf
        assert len(set(off.argmin(axis=1))) == len(one)
        # Fits of circles end within a small share of their deviation.
        np.testing.assert_array_less(off.min(axis=1), 2e-3 if kind == "pole" else 1e-5)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("beams", "noise"), [(360, 0.0), (720, 0.01), (541, 0.02), (180, 0.03)])
def test_features_turn_and_mirror_with_their_scans(backend, beams, noise):
    bearings = bearings_of(beams)
    scans = scans_of(beams, bearings, noise, 4)

    def features(angles, ranges=scans, **options):
        return gs.extract_features(ranges, gs.Scanner(angles, 25.0, **options), KINDS, backend)

    found = features(bearings)
    assert len(found["line"]) > 10
    for turn in (0.5, -2.6, math.pi):
        assert_same(features(bearings, mount=(0.0, 0.0, turn)), found, turn)
        assert_same(features(np.mod(bearings + turn + math.pi, 2 * math.pi) - math.pi), found, turn)
    for shift in (1, beams // 3, beams - 2):
        assert_same(features(np.roll(bearings, shift), np.roll(scans, shift, axis=1)), found)
    assert_same(features(np.mod(bearings, 2 * math.pi)), found)
    assert_same(features(-bearings), found, mirror=True)
    assert_same(features(-bearings[::-1], scans[:, ::-1]), found, mirror=True)


@pytest.mark.parametrize("yaw", [0.0, 0.4, 1.6, 3.0, -1.5])
def test_a_door_without_returns_is_found_at_any_heading(yaw):
    """The opening is the widest gap of the scan."""
    bearings = bearings_of(720)
    c, s = np.cos(bearings), np.sin(bearings)
    with np.errstate(divide="ignore"):
        ranges = np.minimum(np.minimum(2 / np.abs(c), 3 / np.abs(s)), 20.0)
    ranges[(c > 0) & (np.abs(2 * s / np.maximum(c, 0.1)) < 0.45)] = np.inf
    found = gs.extract_features(ranges, gs.Scanner(bearings, 10.0, mount=(0.0, 0.0, yaw)), backend="numpy")["door"]
    assert len(found) == 1 and found.size[0] == pytest.approx(0.9, abs=0.05)
    np.testing.assert_allclose(found.pose[0, :2], (2 * math.cos(yaw), 2 * math.sin(yaw)), atol=0.03)
