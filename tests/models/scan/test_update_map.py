"""Maps that change: after ``update_map`` every result has the bits of a new model of the changed grid."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from support.caster_world import by_name, each_caster

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.models.scan import packed_call
from gpusense.tables import casters
from gpusense.world import windows

RESOLUTION, RANGE_MAX = 0.1, 4.0
BEARINGS = np.linspace(-3, 3, 9)
SCANNER = gs.Scanner(BEARINGS, RANGE_MAX, mount=(0.1, 0.05, 0.3))
FIELDS = {
    "nearest": {"max_distance": 0.72},
    "bilinear": {"max_distance": 0.72, "interpolation": "bilinear"},
    "uncapped": {"max_distance": 1e3},
}
# Contents of patches: free, mostly unknown, some obstacles, only obstacles.
KINDS = ([0], [-1, 0], [0] * 9 + [100], [100])


@pytest.fixture(params=["cpu", "gpu"])
def device(request, backend, monkeypatch):
    """Return each backend with the kernels for processors and with those for GPUs."""
    made = get_backend(backend)
    monkeypatch.setattr(made, "info", dataclasses.replace(made.info, kind=request.param))
    return made


def cells_of(rng, shape, share=0.01):
    return rng.choice([0, 100, -1], shape, p=[0.97 - share, share, 0.03])


def patches(rng, shape, count):
    """Return patches of cells and their positions, the first in two corners."""
    for k in range(count):
        rows, cols = (int(rng.integers(1, min(12, size) + 1)) for size in shape)
        place = [(0, 0), (shape[0] - rows, shape[1] - cols)][k] if k < 2 else None
        if place is None:
            place = int(rng.integers(0, shape[0] - rows + 1)), int(rng.integers(0, shape[1] - cols + 1))
        yield rng.choice(KINDS[int(rng.integers(len(KINDS)))], (rows, cols)), place


def poses_in(rng, shape, count=40):
    high = (shape[1] * RESOLUTION, shape[0] * RESOLUTION, np.pi)
    return rng.uniform((-0.5, -0.5, -np.pi), high, (count, 3))


def changed_by_hand(grid, cells, place):
    patched = grid.cells.copy()
    patched[place[0] : place[0] + cells.shape[0], place[1] : place[1] + cells.shape[1]] = cells
    return gs.OccupancyGrid(patched, grid.resolution, grid.origin, occupied_threshold=grid.occupied_threshold)


def check_edits(make, result, grid, rng, count=7):
    """Edit a model's map repeatedly, and compare its results with those of new models."""
    model = make(grid)
    result(model)
    for cells, place in patches(rng, grid.shape, count):
        model.update_map(cells, place)
        grid = changed_by_hand(grid, cells, place)
        assert model.grid == grid
        np.testing.assert_array_equal(result(model), result(make(grid)))


@pytest.mark.sampled(0.2)
@pytest.mark.parametrize(
    ("method", "precision"), [*((method, "float32") for method in each_caster(16)), ("exact", "float64")], ids=by_name
)
def test_casters_follow(method, precision, device):
    rng = np.random.default_rng(1)
    for shape, outside, unknown in (((60, 75), "free", "occupied"), ((1, 90), "occupied", "free")):
        poses = poses_in(rng, shape)
        check_edits(
            lambda grid, o=outside, u=unknown: gs.RayCaster(
                grid, RANGE_MAX, method=method, backend=device, precision=precision, outside=o, unknown=u
            ),
            lambda caster, p=poses: caster.cast(p, BEARINGS),
            gs.OccupancyGrid(cells_of(rng, shape), RESOLUTION, (0.03, -0.02, 0.1)),
            rng,
        )


@pytest.mark.sampled(0.5)
@pytest.mark.parametrize("specialize", [True, False])
def test_the_beam_model_follows(specialize, device):
    rng = np.random.default_rng(2)
    shape, ranges = (50, 60), rng.uniform(0, RANGE_MAX, len(BEARINGS))
    poses = poses_in(rng, shape)
    check_edits(
        lambda grid: gs.BeamModel(grid, SCANNER, backend=device, specialize=specialize),
        lambda model: np.append(model.log_likelihood(poses, ranges), model.expected_ranges(poses)),
        gs.OccupancyGrid(cells_of(rng, shape), RESOLUTION),
        rng,
    )


@pytest.mark.sampled(0.5)
@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("outside", ["free", "occupied"])
@pytest.mark.parametrize("field", FIELDS.values(), ids=list(FIELDS))
def test_the_field_follows(field, outside, precision, device):
    rng = np.random.default_rng(3)
    shape, ranges = (60, 75), rng.uniform(0, RANGE_MAX, len(BEARINGS))
    poses = poses_in(rng, shape)
    check_edits(
        lambda grid: gs.LikelihoodFieldModel(
            grid, SCANNER, gs.LikelihoodFieldParameters(**field), backend=device, outside=outside, precision=precision
        ),
        lambda model: model.log_likelihood(poses, ranges),
        gs.OccupancyGrid(cells_of(rng, shape, 0.002), RESOLUTION),
        rng,
    )


@pytest.mark.parametrize("outside", ["free", "occupied"])
def test_every_cell_of_an_updated_field_is_that_of_a_new_one(outside, device):
    """Capped at 7.2 cells, distances of 7 cells count, just within reach of an edit."""
    rng, shape = np.random.default_rng(14), (90, 80)
    parameters = gs.LikelihoodFieldParameters(max_distance=0.72)

    def make(grid):
        model = gs.LikelihoodFieldModel(grid, SCANNER, parameters, backend=device, outside=outside)
        model.prepare([[1, 1, 0]])
        return model

    def table(model):
        return device.download(model._pipeline.map._state.table, np.empty((shape[0] + 4, shape[1] + 4), np.float32))

    model = make(gs.OccupancyGrid(np.zeros(shape, int), RESOLUTION))
    for cells, place in patches(rng, shape, 30):
        model.update_map(cells, place)
        np.testing.assert_array_equal(table(model), table(make(model.grid)))
    assert model._pipeline.map.preparations == 1


def tables(model, ranges):
    """Return functions that find a model's table and score poses."""
    if isinstance(model, gs.RayCaster):
        return model._caster.map, lambda poses: model.cast(poses, BEARINGS)
    if isinstance(model, gs.BeamModel):
        return model._caster.map, lambda poses: model.log_likelihood(poses, ranges)
    return model._pipeline.map, lambda poses: model.log_likelihood(poses, ranges)


@pytest.fixture(params=[gs.RayCaster, gs.BeamModel, gs.LikelihoodFieldModel])
def make(request, backend):
    """Return a function that makes a model of each kind."""

    def made(grid):
        if request.param is gs.RayCaster:
            return gs.RayCaster(grid, RANGE_MAX, backend=backend)
        if request.param is gs.BeamModel:
            return gs.BeamModel(grid, SCANNER, backend=backend)
        parameters = gs.LikelihoodFieldParameters(max_distance=0.72)
        return gs.LikelihoodFieldModel(grid, SCANNER, parameters, backend=backend)

    return made


RANGES = np.linspace(0.3, 3.5, len(BEARINGS))


def test_windows_of_the_map_follow(make, monkeypatch):
    """Edit cells in, across and beyond the window, with a cloud that moves away and back."""
    monkeypatch.setattr(windows, "SMALLEST_CELLS", 1)
    # Short calls on GPUs use a table of the whole map.
    monkeypatch.setattr(packed_call, "MOST_CELLS", 0)
    rng = np.random.default_rng(6)
    shape = (400, 500)
    grid = gs.OccupancyGrid(cells_of(rng, shape), RESOLUTION)
    model = make(grid)
    table, says = tables(model, RANGES)
    for step in range(16):
        centre = [(10, 12, 0), (40, 30, 1)][step // 4 % 2]
        poses = rng.normal(centre, 0.3, (20, 3))
        says(poses)
        window, before = table.window, table.preparations
        assert window.cells < 0.5 * shape[0] * shape[1]
        rows, cols = (int(n) for n in rng.integers(1, 40, 2))
        ends = [(window.row, window.col), (window.row + window.rows, window.col + window.cols)]
        row, col = (int(n) for n in rng.choice(ends) + rng.integers(-30, 30, 2))
        row, col = min(max(row, 0), shape[0] - rows), min(max(col, 0), shape[1] - cols)
        cells = rng.choice(KINDS[step % 4], (rows, cols))
        model.update_map(cells, (row, col))
        grid = changed_by_hand(grid, cells, (row, col))
        found = says(poses)
        assert table.preparations == before and table.window == window
        np.testing.assert_array_equal(found, tables(make(grid), RANGES)[1](poses))


def test_the_first_obstacle_and_the_last(make):
    shape = (300, 280)
    grid = gs.OccupancyGrid(np.zeros(shape, int), RESOLUTION)
    model, poses = make(grid), np.random.default_rng(7).normal((14, 15, 0), 1.5, (500, 3))
    says = tables(model, RANGES)[1]
    empty = says(poses)
    model.update_map([[100]], (150, 140))
    other = changed_by_hand(grid, np.array([[100]]), (150, 140))
    found = says(poses)
    np.testing.assert_array_equal(found, tables(make(other), RANGES)[1](poses))
    assert (found != empty).any()
    model.update_map(np.zeros(shape, int), (0, 0))
    assert model.grid == grid
    np.testing.assert_array_equal(says(poses), empty)


def test_edits_that_change_no_obstacle_do_nothing(make, monkeypatch):
    rng = np.random.default_rng(8)
    grid = gs.OccupancyGrid(cells_of(rng, (60, 50)), RESOLUTION)
    model, poses = make(grid), poses_in(rng, (60, 50))
    table, says = tables(model, RANGES)
    before = says(poses)
    buffer, preparations, obstacles = table._state.table, table.preparations, table.obstacles
    monkeypatch.setattr(table, "_refresh", None)
    model.update_map(np.where(grid.cells > 0, 70, 10), (0, 0))
    assert model.grid.cells.max() == 70 and grid.cells.max() == 100
    np.testing.assert_array_equal(says(poses), before)
    assert (table._state.table, table.preparations, table.obstacles) == (buffer, preparations, obstacles)


def test_before_the_first_call_only_the_map_changes(make):
    grid = gs.OccupancyGrid(np.zeros((50, 50), int), RESOLUTION)
    model, poses = make(grid), poses_in(np.random.default_rng(9), (50, 50))
    table, says = tables(model, RANGES)
    model.update_map(np.full((3, 4), 100), [20, 30])
    assert table.preparations == 0
    other = changed_by_hand(grid, np.full((3, 4), 100), (20, 30))
    np.testing.assert_array_equal(says(poses), tables(make(other), RANGES)[1](poses))


def test_a_device_without_room_for_an_update_makes_the_table_anew(make, monkeypatch):
    grid = gs.OccupancyGrid(np.zeros((50, 50), int), RESOLUTION)
    model, poses = make(grid), poses_in(np.random.default_rng(11), (50, 50))
    table, says = tables(model, RANGES)
    says(poses)

    def refuse(*_):
        raise MemoryError

    monkeypatch.setattr(table, "_refresh", refuse)
    model.update_map([[100, 100]], (20, 20))
    other = changed_by_hand(grid, np.array([[100, 100]]), (20, 20))
    np.testing.assert_array_equal(says(poses), tables(make(other), RANGES)[1](poses))
    assert table.preparations == 2


def test_only_cells_that_can_change_are_computed_again(monkeypatch):
    """Count the bytes that reach the device after an edit of 5 x 5 cells of 1000 x 1000."""
    grid = gs.OccupancyGrid(cells_of(np.random.default_rng(12), (1000, 1000)), RESOLUTION)
    device = get_backend("numpy")
    parameters, sizes = gs.LikelihoodFieldParameters(max_distance=0.72), []
    # Patch the class: an undone patch of the device would hide the class's method from later tests.
    kind, upload = type(device), type(device).upload

    def counted(backend, array, out=None):
        sizes.append(array.size)
        return upload(backend, array, out)

    monkeypatch.setattr(kind, "upload", counted)
    for model in (
        gs.BeamModel(grid, SCANNER, backend=device, specialize=False),
        gs.LikelihoodFieldModel(grid, SCANNER, parameters, backend=device, specialize=False),
    ):
        model.prepare([[50.0, 50.0, 0.0]])
        sizes.clear()
        model.update_map(np.full((5, 5), 100), (500, 500))
        assert 0 < sum(sizes) < (2 * 254 + 5) * 1000 + 1


def test_a_look_up_table_from_a_file_cannot_follow(tmp_path):
    grid = gs.OccupancyGrid([[0, 0, 100]], 1.0)
    made = gs.RayCaster(grid, 5.0, method=casters.Lookup(8), backend="numpy")
    made.save_table(tmp_path / "table")
    caster = gs.RayCaster(grid, 5.0, method=casters.Lookup(8, file=tmp_path / "table"), backend="numpy")
    with pytest.raises(ValueError, match=r"^file: must be None where the map changes, got .*table"):
        caster.update_map([[100]], (0, 0))
    assert caster.grid is grid
    made.update_map([[100]], (0, 1))
    made.save_table(tmp_path / "changed")
    caster = gs.RayCaster(made.grid, 5.0, method=casters.Lookup(8, file=tmp_path / "changed"), backend="numpy")
    np.testing.assert_array_equal(caster.cast([[0.5, 0.5, 0]], [0.0]), made.cast([[0.5, 0.5, 0]], [0.0]))


@pytest.mark.parametrize(
    ("cells", "place", "kind", "message"),
    [
        ([[101]], (0, 0), ValueError, "cells: every value must be from -1 to 100, got 101 at index (0, 0)"),
        ([[0]], (-1, 0), ValueError, "region: must put 1 x 1 cells within 2 x 3, got (-1, 0)"),
        ([[0, 0]], (1, 2), ValueError, "region: must put 1 x 2 cells within 2 x 3, got (1, 2)"),
        ([[0]] * 3, (0, 0), ValueError, "region: must put 3 x 1 cells within 2 x 3, got (0, 0)"),
    ],
)
def test_bad_edits_change_nothing(cells, place, kind, message):
    grid = gs.OccupancyGrid([[0, 0, 100], [0, 0, 0]], 1.0)
    field = gs.LikelihoodFieldModel(grid, SCANNER, backend="numpy")
    for model in (gs.RayCaster(grid, 5.0, backend="numpy"), gs.BeamModel(grid, SCANNER, backend="numpy"), field):
        with pytest.raises(kind) as caught:
            model.update_map(cells, place)
        assert str(caught.value) == message
        assert model.grid is grid
    with pytest.raises(kind):
        grid.with_cells(cells, place)


def test_a_grid_with_other_cells_is_read_only_and_keeps_the_rest():
    grid = gs.OccupancyGrid(np.zeros((3, 4), int), 0.5, (1, 2, 0.3), occupied_threshold=50)
    assert grid.occupied.sum() == 0
    other = grid.with_cells([[49, 50]], (2, 1))
    assert other == changed_by_hand(grid, np.array([[49, 50]]), (2, 1)) and other != grid
    assert np.argwhere(other.occupied).tolist() == [[2, 2]]
    with pytest.raises(ValueError, match="read-only"):
        other.cells[0, 0] = 1
