"""The best poses of a grid: branch and bound against brute force, pose by pose in NumPy."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gpusense._util.angles import wrapped
from gpusense.backends import get_backend
from gpusense.backends.workspace import Workspace
from gpusense.matching.pose_grid import PoseGrid, distinct_poses
from gpusense.matching.score_tables import ScoreTables, field_scores
from gpusense.matching.search import Search

BACKENDS = ("numpy", "opencl", "warp")


def scene(tables: int, *, beyond: int = 0):
    """Return tables, end points of scans (one of them without any), and start positions partly off the tables."""
    rng = np.random.default_rng([tables, beyond])
    scores = rng.integers(0, 256, (tables, 33, 47), np.uint8)
    scores[:, 5:25, 10:40] //= 8
    points = [rng.uniform(-30, 30, (count, 2)) for count in (17, 0, 300)]
    start = np.array([[3.2, 4.9], [1.0, 1.0], [-20.5, 30.25]])
    headings = rng.uniform(-4, 4, (3, 5))
    return scores, points, PoseGrid(start, headings, 13, 22)


def brute_force(scores, points, grid, stride, beyond):
    """Return (S, A, H, W) sums, looking up each cell separately."""
    sums = np.zeros((len(points), grid.headings.shape[1], grid.height, grid.width), np.int64)
    rows, cols = scores.shape[1:]
    for s, a in np.ndindex(sums.shape[:2]):
        table = scores[s % len(scores)]
        cos, sin = np.cos(grid.headings[s, a]), np.sin(grid.headings[s, a])
        for i, j in np.ndindex(sums.shape[2:]):
            x = grid.start[s, 0] + (cos * points[s][:, 0] - sin * points[s][:, 1])
            y = grid.start[s, 1] + (sin * points[s][:, 0] + cos * points[s][:, 1])
            col, row = np.floor(x).astype(int) + stride * j, np.floor(y).astype(int) + stride * i
            inside = (col >= 0) & (col < cols) & (row >= 0) & (row < rows)
            sums[s, a, i, j] = table[row[inside], col[inside]].sum() + beyond * np.count_nonzero(~inside)
    return sums


@pytest.mark.parametrize("name", [*BACKENDS, "opencl, as a GPU", "warp, as a GPU"])
@pytest.mark.parametrize(
    ("tables", "stride", "levels", "beyond"), [(1, 1, 3, 0), (3, 1, 2, 0), (1, 2, 2, 7), (3, 3, 1, 255), (1, 1, 0, 9)]
)
def test_branch_and_bound_finds_the_poses_of_brute_force(name, tables, stride, levels, beyond, needs, monkeypatch):
    scores, points, grid = scene(tables, beyond=beyond)
    device = get_backend(needs(name.partition(",")[0]))
    if "," in name:
        monkeypatch.setattr(device, "info", dataclasses.replace(device.info, kind="gpu", lanes=1))
    search = Search(ScoreTables(device, scores, levels=levels, stride=stride, beyond=beyond))
    sums = brute_force(scores, points, grid, stride, beyond)
    allowed = np.random.default_rng(3).random((grid.height, grid.width)) < 0.3
    for mask in (None, allowed):
        counted = sums if mask is None else np.where(mask, sums, -1)
        for slack in (0, 40):
            found = search.find(points, grid, slack=slack, allowed=mask)
            expected = []
            for s in range(len(points)):
                a, i, j = np.nonzero((counted[s] >= counted[s].max() - slack) & (counted[s] >= 0))
                order = np.lexsort((a, j, i, -counted[s][a, i, j]))
                expected.append(np.stack([np.full(len(a), s), i, j, a, counted[s][a, i, j]], axis=1)[order])
            got = np.stack([found.scan, found.row, found.col, found.heading, found.score], axis=1)
            np.testing.assert_array_equal(got, np.concatenate(expected))
            assert found.complete.all()
            brute = search.find(points, grid, slack=slack, allowed=mask, level=0)
            np.testing.assert_array_equal(brute.score, found.score)
            assert brute.evaluated == grid.count


def test_the_best_pose_of_a_room_is_found_by_few_evaluations():
    rows, cols = np.mgrid[:80, :100]
    room = np.minimum(np.minimum(rows, 79 - rows), np.minimum(cols, 99 - cols)) * 0.05
    search = Search(ScoreTables(get_backend("numpy"), field_scores(room, 0.1, 0.5), levels=3))
    turn = np.linspace(-3, 3, 90, endpoint=False)
    cos, sin = np.cos(turn), np.sin(turn)
    with np.errstate(divide="ignore"):
        ends = np.minimum(np.where(cos > 0, 59 / cos, -40 / cos), np.where(sin >= 0, 29 / sin, -50 / sin))
    points = np.stack([ends * cos, ends * sin], axis=1)
    grid = PoseGrid.around(np.array([[44.5, 45.5, 0.1]]), (10, 12), 8, 0.025)
    found = search.find([points], grid)
    pose = grid.poses(found, 1)[found.best[0]]
    np.testing.assert_allclose(pose, (40.5, 50.5, 0.0), atol=1e-9)
    assert found.evaluated < 0.5 * grid.count


def test_devices_without_float64_have_the_poses_of_others(monkeypatch):
    scores, points, grid = scene(3)
    tables = ScoreTables(get_backend("opencl"), scores, levels=2)
    expected = Search(tables).find(points, grid, slack=20)
    monkeypatch.setattr(tables.backend, "info", dataclasses.replace(tables.backend.info, float64=False))
    found = Search(tables).find(points, grid, slack=20)
    for name in ("scan", "row", "col", "heading", "score"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_poses_beyond_the_memory_are_dropped_and_reported(monkeypatch):
    monkeypatch.setattr("gpusense.matching.search._MOST_KEPT", 50)
    scores = np.zeros((20, 20), np.uint8)
    scores[10, 10] = 200
    search = Search(ScoreTables(get_backend("numpy"), scores, levels=2))
    grid = PoseGrid(np.array([[0.5, 0.5]]), np.zeros((1, 1)), 20, 20)
    found = search.find([np.zeros((1, 2))], grid, slack=255)
    assert (found.row[0], found.col[0], found.score[0]) == (10, 10, 200)
    assert not found.complete[0] and len(found.scan) <= 50


@pytest.mark.parametrize("level", [0, 2])
def test_of_equal_poses_beyond_the_memory_the_first_are_kept(monkeypatch, level):
    monkeypatch.setattr("gpusense.matching.search._MOST_KEPT", 50)
    scores = np.zeros((20, 20), np.uint8)
    scores[4:] = 7
    search = Search(ScoreTables(get_backend("numpy"), scores, levels=2))
    found = search.find(
        [np.zeros((1, 2))], PoseGrid(np.array([[0.5, 0.5]]), np.zeros((1, 2)), 20, 20), slack=3, level=level
    )
    assert not found.complete[0]
    ties = [(row, col, heading) for row in (4, 5) for col in range(20) for heading in (0, 1)][:50]
    assert list(zip(found.row, found.col, found.heading, strict=True)) == ties


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize(
    "limits", [{"_MOST_ITEMS": 4}, {"_ROOM": 3, "_READ": 2}, {"_PARTS": dict.fromkeys(("cpu", "gpu"), 16)}]
)
def test_the_poses_are_the_same_in_several_launches(name, limits, monkeypatch, needs):
    scores, points, grid = scene(3)
    tables = ScoreTables(get_backend(needs(name)), scores, levels=2)
    whole = Search(tables).find(points, grid, slack=400)
    for limit, value in limits.items():
        monkeypatch.setattr(f"gpusense.matching.search.{limit}", value)
    parts = Search(tables).find(points, grid, slack=400)
    assert len(whole.scan) > 40
    for name in ("scan", "row", "col", "heading", "score"):
        np.testing.assert_array_equal(getattr(parts, name), getattr(whole, name))


@pytest.mark.parametrize("name", BACKENDS)
def test_exact_bounds_as_on_gpus_divide_fewer_blocks(name, monkeypatch, needs):
    scores, points, grid = scene(3)
    results = []
    for step, unit in ((2, 8), (8, 1)):
        for limit, value in (("_STEP", step), ("_UNIT", unit)):
            monkeypatch.setattr(f"gpusense.matching.score_tables.{limit}", dict.fromkeys(("cpu", "gpu"), value))
        results.append(Search(ScoreTables(get_backend(needs(name)), scores, levels=3)).find(points, grid, slack=50))
    rounded, exact = results
    for field in ("scan", "row", "col", "heading", "score"):
        np.testing.assert_array_equal(getattr(exact, field), getattr(rounded, field))
    assert exact.evaluated < rounded.evaluated


def test_scans_of_other_lengths_repeat_launches_and_copies(monkeypatch):
    """A CUDA graph keeps the sizes and numbers of its launches and copies."""
    device, calls = get_backend("numpy"), []
    compiled, copied = device.compile, Workspace.upload

    def compile_and_note(kernel, flags):
        launch = compiled(kernel, flags)

        def noted(size, *arguments):
            calls.append((kernel, size, *(one for one in arguments if isinstance(one, (int, float, tuple)))))
            launch(size, *arguments)

        return noted

    def copy_and_note(self, name, array):
        calls.append((name, array.shape, array.dtype))
        return copied(self, name, array)

    monkeypatch.setattr(device, "compile", compile_and_note)
    monkeypatch.setattr(Workspace, "upload", copy_and_note)
    monkeypatch.setattr(device, "info", dataclasses.replace(device.info, kind="gpu"))
    scores, _, grid = scene(1)
    search = Search(ScoreTables(device, scores, levels=2))
    rng, noted = np.random.default_rng(0), []
    grid = PoseGrid(grid.start[:1], grid.headings[:1], grid.height, grid.width)
    for count in (330, 340, 350):
        calls.clear()
        search.find([rng.uniform(-9, 9, (count, 2))], grid)
        noted.append([*calls])
    # The first search also makes tables.
    assert len(noted[0]) > len(noted[1])
    assert noted[1] == noted[2]


def test_distinct_poses_are_those_of_a_greedy_choice():
    rng = np.random.default_rng(5)
    for count in (1, 3, 12):
        scan = np.repeat([0, 1, 3], [40, 1, 25])
        poses = np.column_stack([rng.uniform(0, 2, (66, 2)), rng.uniform(-3.2, 3.2, 66)])
        best, expected = np.array([7, 40, 41]), []
        for first, rows in zip(best, (range(40), range(40, 41), range(41, 66)), strict=True):
            chosen = [first]
            for row in rows:
                off = poses[row] - poses[chosen]
                near = (np.hypot(*off[:, :2].T) <= 0.6) & (np.abs(wrapped(off[:, 2])) <= 1.0)
                if len(chosen) < count and not near.any():
                    chosen.append(row)
            expected += chosen
        np.testing.assert_array_equal(distinct_poses(poses, count, 0.6, 1.0, scan, best), expected)
