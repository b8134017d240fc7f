"""Maps of landmarks from features: positions, files, and a filter that uses only landmarks."""

from __future__ import annotations

import csv
import gzip
import math

import numpy as np
import pytest
from support.feature_scenes import floor_plan

import gpusense as gs

SCANNER = gs.Scanner.uniform(angle_min=-2.35, angle_increment=math.radians(0.5), count=540, range_max=12.0)
FLOOR = floor_plan(2)


def corridor_path(count: int, aside: float = 0.0) -> np.ndarray:
    """Return poses along the corridor and back."""
    length, half = FLOOR.hallways[0, 2], count // 2
    x = np.concatenate([np.linspace(1, length - 1, half), np.linspace(length - 1, 1, count - half)])
    theta = np.where(np.arange(count) < half, 0, math.pi) + 0.2 * np.sin(np.arange(count) / 9)
    return np.column_stack([x, aside + 0.25 * np.sin(x), theta])


def scans_at(poses: np.ndarray, seed: int, noise: float = 0.02) -> np.ndarray:
    exact, _ = FLOOR.cast(poses, SCANNER.bearings)
    ranges = exact + noise * np.random.default_rng(seed).standard_normal(exact.shape)
    return np.where(ranges < SCANNER.range_max, ranges, np.inf)


def feature_map_of(found: gs.FeatureMap, kind: str) -> gs.FeatureMap:
    """Return the landmarks of one kind."""
    rows = found.kind == kind
    return gs.FeatureMap(*(getattr(found, name)[rows] for name in ("kind", "pose", "covariance", "size", "count")))


@pytest.fixture(scope="module")
def surveyed() -> gs.FeatureMap:
    """Return the landmarks of a run with small errors of its poses."""
    poses = corridor_path(160)
    features = gs.extract_features(scans_at(poses, 1), SCANNER)
    return gs.map_features(features, poses + np.random.default_rng(9).normal(0, (0.01, 0.01, 0.003), poses.shape))


def test_landmarks_are_where_corners_and_doors_are(surveyed):
    corners, doors = (surveyed.pose[surveyed.kind == kind] for kind in ("corner", "door"))
    assert len(corners) >= 6 and len(doors) >= 2
    off = corners[:, None, :2] - FLOOR.corners[:, :2]
    distance = np.hypot(off[..., 0], off[..., 1])
    assert distance.min(axis=1).max() < 0.04
    nearest = FLOOR.corners[distance.argmin(axis=1)]
    turn = gs.wrap_angle(corners[:, None, 2] - FLOOR.corners[None, :, 2])
    fits = (distance < 0.04) & (np.abs(turn) < 0.1)
    assert fits.any(axis=1).all() and len(nearest) == len(corners)
    middle = 0.5 * (FLOOR.doors[:, :2] + FLOOR.doors[:, 2:])
    apart = np.hypot(*np.moveaxis(doors[:, None, :2] - middle, 2, 0))
    assert apart.min(axis=1).max() < 0.04
    width = np.abs(FLOOR.doors[:, 2] - FLOOR.doors[:, 0])[apart.argmin(axis=1)]
    np.testing.assert_allclose(surveyed.size[surveyed.kind == "door"], width, atol=0.1)
    assert (surveyed.count >= 2).all()
    deviation = np.sqrt(np.einsum("mii->mi", surveyed.covariance[surveyed.kind != "line"]))
    assert (deviation > 1e-4).all() and (deviation < 0.1).all()


@pytest.mark.sampled(0.5)
@pytest.mark.parametrize("beside", ["alone", "lines", "field"])
def test_a_filter_localises_by_features(surveyed, beside):
    """The final error of odometry exceeds the median error of every filter."""
    poses = corridor_path(120, aside=0.1)
    ranges = scans_at(poses, 5)
    features = gs.extract_features(ranges, SCANNER)
    parameters = gs.LandmarkParameters(
        sigma_range=0.1, sigma_bearing=0.03, sigma_signature=0.3, z_detect=0.9, z_false=0.1, range_max=12.0
    )
    landmarks = gs.LandmarkModel(surveyed.landmarks(), parameters)
    models = [landmarks]
    if beside == "lines":
        models.append(gs.LineModel(surveyed.lines(), gs.LineParameters(range_max=12.0)))
    if beside == "field":
        grid = gs.build_map(scans_at(poses, 6), poses, SCANNER, resolution=0.05)
        models.append(gs.LikelihoodFieldModel(grid, SCANNER, gs.LikelihoodFieldParameters(sigma_hit=0.07)))
    pf = gs.ParticleFilter(models, particles=1000, seed=0)
    pf.initialize(mean=poses[0] + (0.3, -0.2, 0.1), covariance=np.diag([0.25, 0.25, 0.04]))
    motions = gs.compose_poses(gs.invert_poses(poses[:-1]), poses[1:])
    motions = motions + np.random.default_rng(3).normal(0, (0.02, 0.01, 0.02), motions.shape)
    odometry, errors = [np.zeros(3)], []
    for k, pose in enumerate(poses):
        if k:
            odometry.append(gs.compose_poses(odometry[-1], motions[k - 1]))
            pf.predict(odometry[-2], odometry[-1])
        readings = features.of_scan(k).range_bearing(("corner", "door", "pole"))
        given = {landmarks: readings} if len(readings) else {}
        if beside != "alone":
            given[models[1]] = ranges[k] if beside == "field" else features.of_scan(k).lines()
        if given:
            pf.correct(given)
        errors.append(math.hypot(*(pf.estimate().pose[:2] - pose[:2])))
    alone = gs.compose_poses(poses[0], odometry[-1])
    assert (
        np.median(errors[20:]) < (0.03 if beside == "lines" else 0.05)
        and np.quantile(errors[20:], 0.95) < 0.2
        and errors[-1] < 0.1
    )
    assert math.hypot(*(alone[:2] - poses[-1, :2])) > 4 * np.median(errors[20:])
    assert pf.estimate().verdict == "tracking"


def test_a_map_has_the_corners_that_are_drawn_in_it(backend):
    cells = np.zeros((100, 160), np.int8)
    cells[[0, -1]] = cells[:, [0, -1]] = 100
    cells[40:60, 70:90] = 100
    grid = gs.OccupancyGrid(cells, resolution=0.05, origin=(10.0, -5.0, math.radians(30)))
    found = gs.landmarks_of_map(grid, backend=backend)
    inner = [(x, y) for x in (0.05, 7.95) for y in (0.05, 4.95)]
    outer = [(x, y) for x in (3.5, 4.5) for y in (2.0, 3.0)]
    c, s = math.cos(math.radians(30)), math.sin(math.radians(30))
    expected = np.array(inner + outer) @ np.array([[c, s], [-s, c]]) + (10.0, -5.0)
    assert found.kind.tolist() == ["line"] * 8 + ["corner"] * 8
    walls = found.lines()
    found = feature_map_of(found, "corner")
    apart = np.hypot(*np.moveaxis(found.pose[:, None, :2] - expected, 2, 0))
    assert sorted(apart.argmin(axis=1)) == list(range(8)) and apart.min(axis=1).max() < 0.03
    opening = np.where(apart.argmin(axis=1) < 4, math.pi / 2, 1.5 * math.pi)
    np.testing.assert_allclose(found.size, opening, atol=0.05)
    # Each wall is as long as the room or the block, with its free side on the left.
    back, turn = (
        (walls.middles - (10.0, -5.0)) @ np.array([[c, -s], [s, c]]),
        walls.normals @ np.array([[c, -s], [s, c]]),
    )
    rows = [(4, 0.05, 7.9, 0, -1), (4, 4.95, 7.9, 0, 1), (0.05, 2.5, 4.9, -1, 0), (7.95, 2.5, 4.9, 1, 0),
            (4, 2, 1, 0, 1), (4, 3, 1, 0, -1), (3.5, 2.5, 1, 1, 0), (4.5, 2.5, 1, -1, 0)]  # fmt: skip
    table = np.column_stack([back, walls.lengths, turn])
    off = np.abs(table[:, None] - rows).max(axis=2)
    assert sorted(off.argmin(axis=1)) == list(range(8)) and off.min(axis=1).max() < 0.1


@pytest.mark.parametrize("value", [0, 100, -1])
def test_maps_without_anything_have_no_landmarks(value):
    grid = gs.OccupancyGrid(np.full((40, 30), value, np.int8), resolution=0.05)
    assert len(gs.landmarks_of_map(grid, backend="numpy")) == 0


def test_kinds_are_chosen_and_saved(surveyed, tmp_path):
    doors = surveyed.landmarks("door")
    assert len(doors) == (surveyed.kind == "door").sum() and (doors.signatures // 10 == 2).all()
    points = surveyed.kind != "line"
    assert len(surveyed.landmarks()) == points.sum() and len(surveyed.lines()) == (~points).sum()
    surveyed.save(tmp_path / "landmarks.csv")
    with open(tmp_path / "landmarks.csv", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["kind"] for row in rows] == surveyed.kind.tolist()
    np.testing.assert_array_equal([[float(row["x"]), float(row["y"])] for row in rows], surveyed.pose[:, :2])
    np.testing.assert_array_equal(
        [float(row["signature"]) for row in rows if row["kind"] != "line"], surveyed.landmarks().signatures
    )


def test_files_come_back_with_their_bits(surveyed, tmp_path):
    path = tmp_path / "landmarks.csv"
    surveyed.save(path)
    packed = tmp_path / "landmarks.csv.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    for file in (path, str(path), packed):
        again = gs.FeatureMap.load(file)
        for name in ("kind", "pose", "covariance", "size", "count"):
            found, expected = getattr(again, name), getattr(surveyed, name)
            assert found.dtype == expected.dtype
            np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(again.lines().segments, surveyed.lines().segments)
    surveyed.save(path)
    gs.map_features(gs.extract_features(np.ones((0, 540)), SCANNER), np.zeros((0, 3))).save(path)
    assert len(gs.FeatureMap.load(path)) == 0


GOOD = "1.0,2.0,11.5,corner,0.5,1.5,0.01,0.0,0.01,3"
BAD_FILES = {
    "empty": ("", 1, "got an empty file"),
    "another file": ("time,x,y\n1,2,3\n", 1, "must be x,y,signature,kind"),
    "a short line": ("HEADER\n" + GOOD + "\n1,2,3\n", 3, "must have 10 columns"),
    "a kind": ("HEADER\n" + GOOD.replace("corner", "hallway"), 2, "kind must be one of line, corner, door, pole"),
    "words": ("HEADER\n" + GOOD.replace("2.0", "two"), 2, "columns other than kind must be numbers"),
    "half a count": ("HEADER\n" + GOOD[:-1] + "3.5", 2, "and count a whole number"),
    "nan": ("HEADER\n" + GOOD.replace("2.0", "nan"), 2, "numbers must be finite"),
    "far": ("HEADER\n" + GOOD.replace("2.0", "1e10"), 2, "coordinates at most 1e\\+09 m"),
    "no size": ("HEADER\n" + GOOD.replace("0.5,1.5", "0.5,0.0"), 2, "size must be above 0"),
    "count": ("HEADER\n" + GOOD[:-1] + "9" * 30, 2, "and count at least 1"),
    "covariance": ("HEADER\n" + GOOD.replace("0.01,0.0,", "0.01,0.02,"), 2, "covariance must be positive semidefinite"),
    "bytes": (b"\xff\xfe\x00", 1, "must be x,y,signature,kind"),
    "a long line": (b"x" * (1 << 24), 1, "must have lines of less than"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_FILES)
def test_broken_files_are_named(name, surveyed, tmp_path):
    text, line, words = BAD_FILES[name]
    surveyed.save(tmp_path / "good.csv")
    header = (tmp_path / "good.csv").read_text(encoding="utf-8").split("\n")[0]
    path = tmp_path / "bad.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.replace("HEADER", header).encode())
    with pytest.raises(ValueError, match=words) as caught:
        gs.FeatureMap.load(path)
    assert str(caught.value).startswith(f"{path}:{line}: ")


def test_features_seen_too_seldom_are_no_landmarks(surveyed):
    poses = corridor_path(160)[:1]
    features = gs.extract_features(scans_at(poses, 1), SCANNER)
    assert len(gs.map_features(features, poses)) == 0
    assert len(gs.map_features(features, poses, least=1)) > 0
    assert len(gs.map_features(features[:0], np.zeros((0, 3)))) == 0
    assert repr(gs.map_features(features[:0], np.zeros((0, 3)))) == "FeatureMap(none)"


def test_a_line_counts_its_own_features():
    """Three pieces of the second wall are together more certain than the only piece of the first one."""
    deviation = np.array([0.010, 0.015, 0.015, 0.015])
    information = np.zeros((4, 3, 3))
    information[:, 1, 1] = information[:, 2, 2] = deviation**-2
    covariance = np.where(information > 0, deviation[:, None, None] ** 2, 0.0)
    covariance[:, 0, 0] = np.inf
    pose = np.column_stack([np.full(4, 2.0), [5.0, 0.0, 0.0, 0.0], np.zeros(4)])
    features = gs.Features(
        np.full(4, "line"), np.arange(4), pose, covariance, information, np.full(4, 4.0), np.ones(4)
    )  # fmt: skip
    found = gs.map_features(features, np.zeros((4, 3)), pose_deviation=(0.0, 0.0))
    assert found.count.tolist() == [3]
    np.testing.assert_allclose(found.pose, [[2.0, 0.0, 0.0]], atol=1e-12)
    both = gs.map_features(features, np.zeros((4, 3)), pose_deviation=(0.0, 0.0), least=1)
    assert sorted(zip(both.pose[:, 1].round(6).tolist(), both.count.tolist(), strict=True)) == [(0.0, 3), (5.0, 1)]
