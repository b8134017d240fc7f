"""Many worlds at once: rays have the bits of single maps, on every backend."""

from __future__ import annotations

import copy
import pickle
import runpy
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.array_libraries import installed

import gpusense as gs

BEARINGS = np.linspace(-3.0, 3.0, 21)
RANGE = 6.0


def some_cells(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Return cells of which some are walls and some are unknown."""
    cells = (rng.random(shape) < 0.05).astype(np.int8) * np.int8(100)
    cells[rng.random(shape) < 0.03] = -1
    return cells


def poses_in(rng: np.random.Generator, grid: gs.OccupancyGrid, count: int) -> np.ndarray:
    """Return poses in a grid and around it."""
    rows, cols = grid.shape
    places = grid.cell_centers(rng.integers(-4, rows + 4, count), rng.integers(-4, cols + 4, count))
    places += rng.uniform(-0.5, 0.5, places.shape) * grid.resolution
    return np.column_stack([places, rng.uniform(-9, 9, count)])


def same_bits(found: np.ndarray, wanted: np.ndarray) -> None:
    """Compare arrays bit by bit."""
    assert found.dtype == wanted.dtype
    assert found.tobytes() == wanted.tobytes()


@pytest.fixture(scope="module")
def grids() -> list[gs.OccupancyGrid]:
    """Return maps of several sizes, with origins far away and turned."""
    rng = np.random.default_rng(1)
    sizes = [(1, 1), (20, 70), (130, 9), (20, 70), (33, 64)]
    origins = [(0, 0, 0), (1, 2, 3), (-5e5, 4e6, 1), (0.3, 0, 0), (0, 0, -0.4)]
    return [gs.OccupancyGrid(some_cells(rng, *size), 0.1, at) for size, at in zip(sizes, origins, strict=True)]


@pytest.mark.long_on("warp")
@pytest.mark.sampled(1)
@pytest.mark.parametrize("options", [{}, {"unknown": "occupied", "outside": "occupied"}, {"precision": "float64"}])
def test_ranges_and_incidence_have_the_bits_of_single_maps(
    options: dict[str, Any], grids: list[gs.OccupancyGrid], backend: str
) -> None:
    rng = np.random.default_rng(2)
    index = rng.permutation(np.arange(len(grids)).repeat(12))
    poses = np.concatenate([poses_in(rng, grids[w], 1) for w in index])
    caster = gs.RayCaster(gs.Worlds(grids, backend=backend), RANGE, backend=backend, **options)
    ranges = caster.cast(poses, BEARINGS, world=index)
    angles = caster.incidence(poses, BEARINGS, world=index)
    for w, grid in enumerate(grids):
        single = gs.RayCaster(grid, RANGE, backend=backend, **options)
        same_bits(ranges[index == w], single.cast(poses[index == w], BEARINGS))
        same_bits(angles[index == w], single.incidence(poses[index == w], BEARINGS))


def test_worlds_of_one_size_have_one_frame_or_one_each(backend: str) -> None:
    rng = np.random.default_rng(3)
    cells, origins = some_cells(rng, 7, 24, 40), rng.uniform(-3, 3, (7, 3))
    for origin in ((1.0, -2.0, 0.5), origins):
        worlds = gs.Worlds(cells, 0.2, origin, backend=backend)
        index = rng.integers(0, 7, 30)
        poses = np.concatenate([poses_in(rng, worlds.grid(w), 1) for w in index])
        ranges = gs.RayCaster(worlds, RANGE, backend=backend).cast(poses, BEARINGS, world=index)
        for w in range(7):
            grid = gs.OccupancyGrid(cells[w], 0.2, np.broadcast_to(origin, (7, 3))[w])
            assert worlds.grid(w) == grid
            single = gs.RayCaster(grid, RANGE, backend=backend).cast(poses[index == w], BEARINGS)
            same_bits(ranges[index == w], single)


def test_replaced_worlds_have_the_bits_of_new_maps(grids: list[gs.OccupancyGrid], backend: str) -> None:
    rng = np.random.default_rng(5)
    worlds = gs.Worlds(grids, backend=backend)
    caster = gs.RayCaster(worlds, RANGE, backend=backend)
    index = np.arange(len(grids)).repeat(6)
    poses = np.concatenate([poses_in(rng, grids[w], 1) for w in index])
    caster.cast(poses, BEARINGS, world=index)
    caster.incidence(poses, BEARINGS, world=index)
    changed = {w: some_cells(rng, *grids[w].shape) for w in (3, 1)}
    worlds.replace([3, 1], np.stack(list(changed.values())))
    ranges = caster.cast(poses, BEARINGS, world=index)
    angles = caster.incidence(poses, BEARINGS, world=index)
    for w, grid in enumerate(grids):
        now = gs.OccupancyGrid(changed.get(w, grid.cells), grid.resolution, grid.origin)
        assert worlds.grid(w) == now
        single = gs.RayCaster(now, RANGE, backend=backend)
        same_bits(ranges[index == w], single.cast(poses[index == w], BEARINGS))
        same_bits(angles[index == w], single.incidence(poses[index == w], BEARINGS))


def test_one_world_needs_no_index(backend: str) -> None:
    grid = gs.OccupancyGrid(some_cells(np.random.default_rng(6), 20, 20), 0.1)
    worlds = gs.Worlds([grid], backend=backend)
    assert len(worlds) == 1
    found = gs.RayCaster(worlds, RANGE, backend=backend).cast([(1.0, 1.0, 0.3)], BEARINGS)
    same_bits(found, gs.RayCaster(grid, RANGE, backend=backend).cast([(1.0, 1.0, 0.3)], BEARINGS))


CELLS = np.zeros((2, 3, 4), np.int8)


def test_grids_must_agree_in_resolution() -> None:
    grids = [gs.OccupancyGrid(CELLS[0], 0.1), gs.OccupancyGrid(CELLS[0], 0.2)]
    with pytest.raises(ValueError, match=r"^resolution: must be the same for all worlds, got \[0.1, 0.2\]"):
        gs.Worlds(grids, backend="numpy")


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({}, ValueError, r"^world: must be an index of one of 2 worlds for each pose, got None"),
        ({"world": [0, 2]}, ValueError, r"^world: every index must be in \[0, 2\), got 2"),
        ({"world": [0, -1]}, ValueError, r"^world: every index must be in \[0, 2\), got -1"),
        ({"world": [0]}, ValueError, r"^world: shape must be \(2,\), got \(1,\)"),
        ({"world": [0.0, 1.0]}, TypeError, r"^world: must hold integers, got dtype float64"),
        ({"world": [True, False]}, TypeError, r"^world: must hold integers, got dtype bool"),
    ],
)
def test_bad_indices_are_refused(options: dict[str, Any], error: type, words: str) -> None:
    caster = gs.RayCaster(gs.Worlds(CELLS, backend="numpy"), RANGE, backend="numpy")
    with pytest.raises(error, match=words):
        caster.cast(np.zeros((2, 3)), [0.0], **options)


def test_a_single_map_takes_no_index() -> None:
    caster = gs.RayCaster(gs.OccupancyGrid(CELLS[0]), RANGE, backend="numpy")
    with pytest.raises(ValueError, match=r"^world: must be None for a model of a single map, got 0"):
        caster.cast([(0.0, 0.0, 0.0)], [0.0], world=0)


def test_models_must_be_on_the_device_of_the_worlds(needs: Any) -> None:
    worlds = gs.Worlds(CELLS, backend="numpy")
    with pytest.raises(ValueError, match=r"^grid: must be Worlds on the model's device .*, got backend='numpy'"):
        gs.RayCaster(worlds, RANGE, backend=needs("opencl"))
    with pytest.raises(ValueError, match=r"^caster: must be 'exact' in Worlds, got 'march'"):
        gs.RayCaster(worlds, RANGE, backend="numpy", method="march")


@pytest.mark.parametrize(
    ("index", "cells", "error", "words"),
    [
        ([0, 2], CELLS, ValueError, r"^index: every index must be in \[0, 2\), got 2"),
        ([1, 1], CELLS, ValueError, r"^index: every world must occur once"),
        ([0], CELLS, ValueError, r"^cells: sizes must be those of the worlds"),
        ([0, 1], CELLS[:, :2], ValueError, r"^cells: sizes must be those of the worlds"),
        ([0, 1], CELLS.astype(bool), TypeError, r"^cells: must hold integers"),
    ],
)
def test_bad_replacements_change_nothing(index: Any, cells: Any, error: type, words: str) -> None:
    worlds = gs.Worlds(CELLS, backend="numpy")
    with pytest.raises(error, match=words):
        worlds.replace(index, cells)
    assert (worlds.grid(0).cells == 0).all()


def test_worlds_that_do_not_fit_say_how_many_do(monkeypatch: pytest.MonkeyPatch) -> None:
    import dataclasses

    from gpusense.backends import get_backend

    device = get_backend("numpy")
    monkeypatch.setattr(device, "info", dataclasses.replace(device.info, max_buffer=1100))
    with pytest.raises(MemoryError, match=r"^cells: must fit into the memory of .*: 2 of 10 worlds of 1 bytes a cell"):
        gs.Worlds(np.zeros((10, 16, 16), np.int8), backend=device)


def test_copies_and_pickles_have_the_same_cells_and_shapes(grids: list[gs.OccupancyGrid], backend: str) -> None:
    worlds = gs.Worlds(grids, backend=backend)
    worlds.shapes = gs.Shapes(discs=np.tile([1.0, 2.0, 0.4], (len(grids), 1, 1)))
    caster = gs.RayCaster(worlds, RANGE, backend=backend)
    poses, index = np.array([(1.0, 1.0, 0.3)] * len(grids)), np.arange(len(grids))
    wanted = caster.cast(poses, BEARINGS, world=index)
    for made in (pickle.loads(pickle.dumps(worlds)), copy.copy(worlds), copy.deepcopy(worlds)):
        assert [made.grid(k) for k in range(len(made))] == [worlds.grid(k) for k in range(len(worlds))]
        same_bits(gs.RayCaster(made, RANGE, backend=backend).cast(poses, BEARINGS, world=index), wanted)
    same_bits(pickle.loads(pickle.dumps(caster)).cast(poses, BEARINGS, world=index), wanted)


def test_grids_replace_grids_of_the_same_frame() -> None:
    worlds = gs.Worlds(CELLS, 0.1, (1.0, 2.0, 0.0), backend="numpy")
    full = gs.OccupancyGrid(CELLS[0] + 100, 0.1, (1.0, 2.0, 0.0))
    worlds.replace([1], [full])
    assert worlds.grid(1) == full
    assert (worlds.grid(0).cells == 0).all()
    for other, words in (
        (gs.OccupancyGrid(CELLS[0], 0.2, (1.0, 2.0, 0.0)), "^resolution: must be the same"),
        (gs.OccupancyGrid(CELLS[0], 0.1), r"^cells\[0\]: origin must be"),
        (gs.OccupancyGrid(CELLS[0], 0.1, (1.0, 2.0, 0.0), occupied_threshold=50), "^occupied_threshold: must be"),
    ):
        with pytest.raises(ValueError, match=words):
            worlds.replace([1], [other])
    assert worlds.grid(1) == full


def test_indices_of_shapes_are_checked_and_empty_lists_are_indices() -> None:
    worlds, pose = gs.Worlds(CELLS, 1.0, backend="numpy"), [(1.0, 1.0, 0.0)]
    caster = gs.RayCaster(worlds, 3.0, backend="numpy")
    model = gs.BeamModel(worlds, gs.Scanner([0.0], range_max=3.0), backend="numpy")
    with pytest.raises(ValueError, match=r"^ignore: every index must be in \[-1, 0\), got"):
        worlds.collides(pose, 0.1, world=0, ignore=0)
    worlds.shapes = gs.Shapes(discs=np.tile([1.0, 1.0, 0.5], (2, 1, 1)), segments=np.full((2, 1, 4), np.nan))
    assert not worlds.collides(pose, 0.1, world=0, ignore=0).any()
    for none in (-1, 1, [np.int8(-1)]):
        assert worlds.collides(pose, 0.1, world=0, ignore=none).all()
    for wrong in (2, [-2], 1 << 32, -(1 << 32), [1 << 32], np.uint64(1 << 63)):
        for call in (
            lambda ignore: worlds.collides(pose, 0.1, world=0, ignore=ignore),
            lambda ignore: caster.cast(pose, [0.0], world=0, ignore=ignore),
            lambda ignore: model.log_likelihood(pose, [1.0], world=0, ignore=ignore),
        ):
            with pytest.raises(ValueError, match=r"^ignore: .*must be"):
                call(wrong)
    assert worlds.collides(np.empty((0, 3)), 0.1, world=[]).shape == (0,)


def test_functions_of_a_single_map_refuse_worlds() -> None:
    model = gs.LikelihoodFieldModel(gs.Worlds(CELLS, backend="numpy"), gs.Scanner([0.0], range_max=2.0),
                                    backend="numpy")  # fmt: skip
    for call in (
        lambda: gs.locate_scan(model, [1.0]), lambda: gs.pose_likelihood(model, [1.0]), lambda: gs.PoseMonitor(model),
        lambda: gs.ParticleFilter(model),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=r"^models?: must be of a single map"):
            call()


@pytest.mark.parametrize("library", ["fakelib", "torch"])
def test_arrays_of_other_libraries_come_back_in_them(
    library: str, backend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cells, poses, indices and shapes arrive by DLPack."""
    installed(monkeypatch)
    made = sys.modules["fakelib"] if library == "fakelib" else pytest.importorskip(library)
    rng = np.random.default_rng(9)
    cells, index, results = some_cells(rng, 3, 20, 30), np.arange(3).repeat(3), []
    poses = rng.uniform(0, 2, (9, 3))
    discs = np.concatenate([rng.uniform(0, 2, (3, 4, 2)), np.full((3, 4, 1), 0.1)], axis=2)
    for to in (np.asarray, made.from_dlpack):
        worlds = gs.Worlds(to(cells), 0.1, backend=backend)
        worlds.shapes = gs.Shapes(discs=to(discs))
        caster = gs.RayCaster(worlds, RANGE, backend=backend)
        seen = caster.cast(to(poses), BEARINGS, world=to(index), ignore=to(0 * index))
        hit = worlds.collides(to(poses), 0.2, world=to(index))
        worlds.replace(to(np.array([1])), to(cells[:1]))
        results.append((seen, hit, caster.cast(to(poses), BEARINGS, world=to(index))))
    for given, found in zip(*results, strict=True):
        assert type(found) is type(made.from_dlpack(given))
        same_bits(np.from_dlpack(found), given)


def test_a_vector_environment_takes_and_gives_arrays_of_a_library(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("gymnasium")
    pytest.importorskip("warp")
    installed(monkeypatch)
    made = runpy.run_path(str(Path(__file__).parents[2] / "examples" / "many_worlds" / "navigation.py"))["Navigation"]
    wrap, rng = sys.modules["fakelib"].from_dlpack, np.random.default_rng(0)
    plain = made(rooms=4, beams=9, longest=3, backend="numpy")
    wrapped = made(rooms=4, beams=9, longest=3, backend="numpy", wrap=wrap)
    same_bits(np.from_dlpack(wrapped.reset(seed=1)[0]), plain.reset(seed=1)[0])
    ages = []
    for _ in range(6):
        actions = rng.uniform(-1, 1, (4, 2)).astype(np.float32)
        results = plain.step(actions)
        for found, given in zip(wrapped.step(wrap(actions))[:4], results[:4], strict=True):
            assert type(found).__name__ == "Array"
            same_bits(np.from_dlpack(found), given)
        observation, reward, terminated, truncated, _ = results
        ages.append(plain.state["age"].numpy().copy())
        np.testing.assert_array_equal(truncated, (ages[-1] == 3) & (terminated == 0))
        # An episode begins at the step after the end of the last one, without a reward.
        assert (reward[ages[-1] == 0] == 0).all()
        poses = plain.state["poses"].numpy()
        seen = gs.RayCaster(plain.worlds, 6.0, backend="numpy").cast(
            poses, np.linspace(-np.pi, np.pi, 9, endpoint=False), world=range(4)
        )
        np.testing.assert_allclose(observation[:, :9], seen / np.float32(6), rtol=1e-6)
    assert (np.array(ages) == 0).any()
