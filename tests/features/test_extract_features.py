"""Features of scans: recall, precision and covariance in floors of known geometry, devices, and bad input."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from support.feature_scenes import Floor, floor_plan
from support.feature_scores import Score, score_scan, truth_of

import gpusense as gs
from gpusense.backends import get_backend

KINDS = ("line", "corner", "door", "hallway", "pole")


def ring(count: int, range_max: float = 25.0, **options) -> gs.Scanner:
    return gs.Scanner.uniform(
        angle_min=-math.pi, angle_increment=2 * math.pi / count, count=count, range_max=range_max, **options
    )


def front(count: int = 1081) -> gs.Scanner:
    return gs.Scanner.uniform(
        angle_min=-0.75 * math.pi, angle_increment=1.5 * math.pi / (count - 1), count=count, range_max=25.0
    )


def floor_scans(seed: int, scanner: gs.Scanner, noise: float, count: int = 12):
    floor = floor_plan(seed)
    poses = floor.poses(count, seed)
    exact, surface = floor.cast(poses, scanner.bearings)
    ranges = exact + noise * np.random.default_rng([seed, 3]).standard_normal(exact.shape)
    truth = [truth_of(floor, *row) for row in zip(poses, [scanner.bearings] * count, exact, surface, strict=True)]
    return ranges, truth


def square_room(scanner: gs.Scanner, half: float = 2.0, x: float = 0.0, y: float = 0.0) -> np.ndarray:
    c, s = np.cos(scanner.bearings), np.sin(scanner.bearings)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.fmin((half * np.sign(c) - x) / c, (half * np.sign(s) - y) / s)


@pytest.fixture(scope="module")
def scores():
    """Return scores of floors by beams and noise."""
    found: dict[tuple[int, float], dict[str, Score]] = {}
    for beams, noise in ((360, 0.0), (180, 0.01), (360, 0.03), (1081, 0.01), (1081, 0.05)):
        scanner = front() if beams == 1081 else ring(beams)
        total = found.setdefault((beams, noise), {})
        for seed in range(5):
            ranges, truth = floor_scans(seed, scanner, noise)
            features = gs.extract_features(ranges, scanner)
            for k, one in enumerate(truth):
                score_scan(features.of_scan(k), one, total)
    return found


def test_lines_are_those_of_the_line_model():
    """Compare angle, distance, ends and covariance in normal form, for a scanner off the robot's centre."""
    scanner = ring(720, mount=(0.2, -0.1, 0.4))
    walls = gs.LineMap([(3, -2, 3, 2), (3, 2, -1, 2), (-1, 2, -1, -2), (-1, -2, 3, -2)], two_sided=False)
    place = gs.compose_poses(np.zeros(3), np.array(scanner.mount))
    directions = scanner.bearings + place[2]
    c, s = np.cos(directions), np.sin(directions)
    exact = np.fmin(np.where(c > 0, 3 - place[0], -1 - place[0]) / c, np.where(s > 0, 2 - place[1], -2 - place[1]) / s)
    squares = []
    for seed in range(40):
        noise = 0.02 * np.random.default_rng(seed).standard_normal(exact.shape)
        lines = gs.extract_features(exact + noise, scanner, "line", noise=0.02).lines()
        for angle, distance, first, last, va, both, vd in lines:
            j = np.abs(gs.wrap_angle(np.arctan2(*walls.normals.T[::-1]) - angle)).argmin()
            normal = walls.normals[j]
            error = np.array(
                [gs.wrap_angle(angle - math.atan2(normal[1], normal[0])), distance - normal @ walls.middles[j]]
            )
            squares.append(error @ np.linalg.solve([[va, both], [both, vd]], error))
            along = np.array([-normal[1], normal[0]])
            ends = np.sort(walls.segments[j].reshape(2, 2) @ along)
            assert ends[0] - 0.1 < first < last < ends[1] + 0.1
    assert len(squares) >= 160 and 1.7 < np.mean(squares) < 2.4
    model = gs.LineModel(walls, backend="numpy")
    assert model.log_likelihood([(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), (0, 0, 0.05)], lines).argmax() == 0
    assert (model.associate([(0, 0, 0)], lines)[0] >= 0).all()


def test_most_features_that_are_seen_well_are_found(scores):
    least = {"line": 0.97, "corner": 0.95, "door": 0.85, "hallway": 0.9, "pole": 0.8}
    for setting, by_kind in scores.items():
        for kind in KINDS:
            assert by_kind[kind].required >= 5, (setting, kind)
            assert by_kind[kind].recall >= least[kind], (setting, kind, by_kind[kind].recall)


def test_most_features_exist(scores):
    least = {"line": 0.97, "corner": 0.98, "door": 0.85, "hallway": 0.9, "pole": 0.7}
    for setting, by_kind in scores.items():
        for kind in KINDS:
            assert by_kind[kind].precision >= least[kind], (setting, kind, by_kind[kind].precision)


def test_covariances_are_those_of_errors(scores):
    """The median of chi squared over its degrees of freedom is 0.69 for 2 and 0.79 for 3; the mean of lines is 1."""
    for (beams, noise), by_kind in scores.items():
        if noise == 0:
            assert all(np.median(by_kind[kind].squares) < 0.5 for kind in KINDS)
            continue
        assert 0.8 < by_kind["line"].nees < 1.35, (beams, noise)
        for kind in ("line", "corner", "pole"):
            assert 0.45 < np.median(by_kind[kind].squares) < 1.25, (beams, noise, kind)


@pytest.mark.long_on("warp")
@pytest.mark.sampled(0.5)
@pytest.mark.parametrize(("beams", "noise"), [(360, 0.0), (180, 0.05), (1081, 0.02)])
def test_devices_agree_with_the_reference(device, beams, noise):
    scanner = front() if beams == 1081 else ring(beams, range_max=8.0)
    ranges, _ = floor_scans(3, scanner, noise, count=6)
    expected = gs.extract_features(ranges, scanner, backend="numpy")
    found = gs.extract_features(ranges, scanner, backend=device.info.selection)
    assert set(expected.kind) >= {"line", "corner", "pole"}
    np.testing.assert_array_equal(found.kind, expected.kind)
    np.testing.assert_array_equal(found.scan, expected.scan)
    np.testing.assert_allclose(found.pose, expected.pose, atol=1e-6)
    np.testing.assert_allclose(found.size, expected.size, atol=1e-6)
    np.testing.assert_allclose(found.information, expected.information, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_ties_are_the_same_in_float32(noise, monkeypatch, needs):
    """Some splits on these floors are closer than float32's rounding, and once differed."""
    device, scanner = get_backend(needs("opencl")), ring(720)
    ranges, _ = floor_scans(1, scanner, 0.0, 20)
    ranges = ranges + noise * np.random.default_rng(1).standard_normal(ranges.shape)
    expected = gs.extract_features(ranges, scanner, backend=device.info.selection)
    monkeypatch.setattr(device, "info", dataclasses.replace(device.info, float64=False))
    found = gs.extract_features(ranges, scanner, backend=device.info.selection)
    np.testing.assert_array_equal(found.kind, expected.kind)
    np.testing.assert_array_equal(found.scan, expected.scan)


@pytest.mark.long_on("warp")
@pytest.mark.parametrize("beams", [0, 1, 2, 3, 10, 180, 1081])
def test_scans_without_features_have_none(backend, beams):
    scanner, rng = ring(beams) if beams else gs.Scanner([], range_max=25.0), np.random.default_rng(beams)
    b = scanner.bearings
    scans = {
        "no return": np.full(beams, np.inf), "at the limit": np.full(beams, 25.0), "nan": np.full(beams, np.nan),
        "zero": np.zeros(beams), "one beam": np.where(np.arange(beams) == beams // 2, 3.0, np.inf),
        "nearly zero": np.full(beams, 1e-7), "circle": np.full(beams, 3.0),
        "circle about another place": 0.8 * np.cos(b) + np.sqrt(9 - (0.8 * np.sin(b)) ** 2),
        "large circle": 4 * np.cos(b) + np.sqrt(100 - (4 * np.sin(b)) ** 2),
        "round, with noise": 3 + 0.03 * rng.standard_normal(beams),
    }  # fmt: skip
    features = gs.extract_features(np.array(list(scans.values())), scanner, backend=backend)
    assert len(features) == 0, [(list(scans)[k], kind) for k, kind in zip(features.scan, features.kind, strict=True)]
    assert len(gs.extract_features(np.zeros((0, beams)), scanner, backend=backend)) == 0


def test_beams_of_one_bearing_raise_nothing(backend):
    bearings = np.repeat(np.linspace(-1, 1, 90), 2)
    scanner = gs.Scanner(bearings, range_max=20.0)
    wall = gs.extract_features(2 / np.cos(bearings), scanner, backend=backend)
    assert set(wall.kind) <= {"line"}
    still = gs.Scanner(np.zeros(60), range_max=20.0)
    ranges = np.random.default_rng(0).uniform(1, 5, 60)
    assert len(gs.extract_features(ranges, still, backend=backend)) == 0


@pytest.mark.parametrize("beams", [180, 720, 1081])
@pytest.mark.parametrize("turn", [0.0, 0.3, math.pi / 4])
def test_a_square_room_has_four_walls_and_corners(backend, beams, turn):
    """The first wall of a scan is one line for any first bearing."""
    bearings = turn + np.arange(beams) * 2 * math.pi / beams
    scanner = gs.Scanner(np.mod(bearings + math.pi, 2 * math.pi) - math.pi, range_max=9.0)
    found = gs.extract_features(square_room(scanner, x=0.4, y=-0.3), scanner, backend=backend)
    assert found.kind.tolist() == ["line"] * 4 + ["corner"] * 4
    corners = found["corner"]
    expected = {(x - 0.4, y + 0.3) for x in (-2, 2) for y in (-2, 2)}
    assert {(round(x, 3) + 0.0, round(y, 3) + 0.0) for x, y in corners.pose[:, :2]} == {
        (round(x, 3), round(y, 3)) for x, y in expected
    }
    # In float32 a beam next to a corner may go to the second wall, by less than the least noise of 3 mm.
    np.testing.assert_allclose(corners.size, math.pi / 2, atol=3e-4)
    # Bisectors point into the room.
    inward = corners.pose[:, :2] + 0.5 * np.column_stack([np.cos(corners.pose[:, 2]), np.sin(corners.pose[:, 2])])
    assert (np.abs(inward + np.array([0.4, -0.3])) < 2).all()


@pytest.mark.parametrize(("swing", "least"), [(-70, 0.97), (-45, 0.97), (60, 0.6), (90, 0.6)])
def test_doors_have_leaves(swing, least):
    """A leaf opens out of the room (-) or into it (+), where it hides a jamb or the adjacent wall."""
    near, far, angle = 1.5, 2.4, math.radians(swing)
    leaf = (0, near, 0.9 * math.sin(angle), near + 0.9 * math.cos(angle))
    room = [(0, 0, 6, 0), (6, 0, 6, 4), (6, 4, 0, 4), (0, 4, 0, far), (0, near, 0, 0), leaf]
    outside = [(-4, -3, -4, 8), (-4, 8, 9, 8), (9, 8, 9, -3), (9, -3, -4, -3)]
    floor = Floor(
        np.array(room + outside, float), np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 5)),
        np.array([[0.6, 0.6, 5.4, 3.4]]),
    )  # fmt: skip
    poses, scanner = floor.poses(60, 1), ring(720, range_max=12.0)
    exact, _ = floor.cast(poses, scanner.bearings)
    c, s = np.cos(scanner.bearings), np.sin(scanner.bearings)
    ends = gs.compose_poses(poses[:, None], np.stack([exact * c, exact * s, 0 * exact], axis=-1))
    visible = (ends[..., 0] < -1.0).sum(axis=1) > 15
    ranges = exact + 0.01 * np.random.default_rng(0).standard_normal(exact.shape)
    doors = gs.extract_features(ranges, scanner, kinds="door")
    centre = gs.compose_poses(poses[doors.scan], doors.pose)
    right = np.hypot(centre[:, 0], centre[:, 1] - 0.5 * (near + far)) < 0.2
    assert right.sum() >= right.size - 1
    assert visible.sum() > 12 and np.isin(np.flatnonzero(visible), doors.scan[right]).mean() >= least


def test_poses_are_in_the_robots_frame():
    mount = (0.3, -0.2, 0.0)
    plain, mounted = ring(720), ring(720, mount=mount)
    ranges, _ = floor_scans(4, plain, 0.01, count=4)
    one, two = (gs.extract_features(ranges, scanner, backend="numpy") for scanner in (plain, mounted))
    for kind in ("line", "corner", "door", "pole"):
        a, b = one[kind], two[kind]
        assert len(a) == len(b) > 0
        np.testing.assert_allclose(a.pose + np.array([0.3, -0.2, 0]), b.pose, atol=1e-12)
    # A hallway's point is abreast of the robot, not of the scanner.
    hall = two["hallway"]
    assert len(hall) == len(one["hallway"])
    along = np.column_stack([np.cos(hall.pose[:, 2]), np.sin(hall.pose[:, 2])])
    np.testing.assert_allclose((hall.pose[:, :2] * along).sum(axis=1), 0, atol=1e-9)


def test_a_turned_scanner_sees_the_same():
    """Scans differ only in their first bearing."""
    plain, turned = ring(720), ring(720, mount=(0.3, -0.2, 1.1))
    ranges, _ = floor_scans(4, plain, 0.01, count=4)
    one, two = (gs.extract_features(ranges, scanner, kinds=("corner", "pole")) for scanner in (plain, turned))
    c, s = math.cos(1.1), math.sin(1.1)
    assert len(one) == len(two) > 10
    np.testing.assert_allclose(one.pose[:, :2] @ np.array([[c, s], [-s, c]]) + (0.3, -0.2), two.pose[:, :2], atol=2e-3)


def test_covariance_is_infinite_along_what_is_not_observed():
    scanner = ring(720)
    ranges, _ = floor_scans(4, scanner, 0.01, count=12)
    found = gs.extract_features(ranges, scanner)
    assert set(found.kind) == set(KINDS)
    for one in found:
        covariance, information, theta = one.covariance[0], one.information[0], one.pose[0, 2]
        along = np.array([math.cos(theta), math.sin(theta), 0.0])
        if one.kind[0] in ("line", "hallway"):
            assert np.isinf(covariance[0, 0]) or np.isinf(covariance[1, 1])
            assert np.isfinite(covariance[2, 2])
            np.testing.assert_allclose(information @ along, 0, atol=1e-9 * np.abs(information).max())
        elif one.kind[0] == "pole":
            assert np.isinf(covariance[2, 2]) and np.isfinite(covariance[:2, :2]).all() and theta == 0
            assert (information[2] == 0).all()
        else:
            np.testing.assert_allclose(covariance @ information, np.eye(3), atol=1e-6)
        assert 0 <= one.score[0] <= 1 and np.isfinite(information).all()
        assert not np.isnan(covariance).any()


def test_one_scan_and_several_give_the_same():
    scanner = ring(360)
    ranges, _ = floor_scans(0, scanner, 0.02, count=5)
    together = gs.extract_features(ranges, scanner)
    for k in range(5):
        alone = gs.extract_features(ranges[k], scanner)
        mine = together.of_scan(k)
        assert (alone.scan == 0).all() and alone.kind.tolist() == mine.kind.tolist()
        np.testing.assert_array_equal(alone.pose, mine.pose)


def test_scans_in_several_parts_give_the_same(monkeypatch):
    scanner = ring(360)
    ranges, _ = floor_scans(0, scanner, 0.02, count=7)
    together = gs.extract_features(ranges, scanner)
    monkeypatch.setattr("gpusense.features.extract._READINGS", 3 * 360)
    parts = gs.extract_features(ranges, scanner)
    np.testing.assert_array_equal(parts.scan, together.scan)
    np.testing.assert_array_equal(parts.pose, together.pose)


@pytest.mark.parametrize("beams", [360, 1081])
@pytest.mark.parametrize("noise", ["auto", 0.02])
def test_independent_ranges_have_no_poles(beams, noise):
    """At most one of 40 scans has a pole by chance."""
    rng, scanner = np.random.default_rng(1), ring(beams)
    clutter = (
        3 + rng.exponential(0.5, (40, beams)),
        rng.uniform(1, 5, (40, beams)),
        2 + np.abs(rng.normal(size=(40, beams))),
    )
    for ranges in clutter:
        assert len(gs.extract_features(ranges, scanner, "pole", noise=noise)) <= 1
    # A pole in front of them is still found.
    off = scanner.bearings - scanner.bearings[beams // 3]
    near = 0.8 * np.cos(off) - np.sqrt(np.maximum(0.12**2 - (0.8 * np.sin(off)) ** 2, 0))
    ranges = np.maximum(clutter[1], np.where(np.cos(off) > 0.9, 2.0, 0.0))
    ranges = np.where((np.abs(np.sin(off)) < 0.15) & (np.cos(off) > 0), near, ranges)
    found = gs.extract_features(ranges, scanner, "pole", noise=0.02)
    assert (np.abs(found.size - 0.12) < 0.01).sum() == len(ranges)


def test_features_become_readings_of_landmarks():
    scanner = ring(720)
    ranges, _ = floor_scans(4, scanner, 0.01, count=12)
    found = gs.extract_features(ranges, scanner)
    rows = found.range_bearing()
    assert rows.shape == (len(found), 3)
    np.testing.assert_allclose(rows[:, 0], np.hypot(found.pose[:, 0], found.pose[:, 1]))
    np.testing.assert_allclose(rows[:, 1], np.arctan2(found.pose[:, 1], found.pose[:, 0]))
    np.testing.assert_array_equal(found.range_bearing("corner"), rows[found.kind == "corner"])
    both = found.range_bearing(("door", "pole"))
    assert len(both) == np.isin(found.kind, ("door", "pole")).sum()
    # No signature belongs to two kinds.
    for number, kind in enumerate(KINDS):
        mine = found[kind].signatures
        assert (mine >= 10 * number).all() and (mine < 10 * number + 9.01).all()


def test_kinds_are_those_asked_for():
    scanner = ring(720)
    ranges, _ = floor_scans(4, scanner, 0.01, count=6)
    every = gs.extract_features(ranges, scanner)
    for kinds in ("corner", ["pole", "line"], ()):
        found = gs.extract_features(ranges, scanner, kinds=kinds)
        wanted = [kinds] if isinstance(kinds, str) else list(kinds)
        assert found.kind.tolist() == every[np.isin(every.kind, wanted)].kind.tolist()
