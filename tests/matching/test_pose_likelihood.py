"""Likelihoods over all poses of a map: the model's values, entropy, modes, tiles and pictures."""

from __future__ import annotations

import math

import numpy as np
import pytest

import gpusense as gs
from gpusense._util.angles import wrapped
from gpusense.matching.pose_likelihood import prepare_tiles, refine_modes

SCANNER = gs.Scanner.uniform(angle_min=-1.5, angle_increment=0.25, count=13, range_max=6.0)


def room() -> gs.OccupancyGrid:
    cells = np.pad(np.zeros((15, 23), int), 1, constant_values=100)
    cells[1:9, 14] = 100
    cells[12:14, 3:6] = -1
    return gs.OccupancyGrid(cells, 0.2, (1e5, -3.0, 0.8))


@pytest.mark.parametrize("kind", [gs.BeamModel, gs.LikelihoodFieldModel])
def test_values_are_those_of_the_model(backend, kind, monkeypatch):
    monkeypatch.setattr("gpusense.matching.pose_likelihood._TILE", 500)
    grid = room()
    model = kind(grid, SCANNER, backend=backend)
    (xy,) = grid.cell_centers([5], [8])
    ranges = gs.BeamModel(grid, SCANNER, backend="numpy").expected_ranges(np.array([[*xy, 0.7]]))[0]
    p = gs.pose_likelihood(model, ranges, resolution=0.4, headings=9)
    assert p.log_p.shape == (9, 13, 9) and p.resolution == pytest.approx(0.4)
    # The last tiles have one row and one column of the map's 17 x 25 cells.
    rows, cols = np.meshgrid([*range(1, 17, 2), 16], [*range(1, 25, 2), 24], indexing="ij")
    centers = grid.cell_centers(rows.ravel(), cols.ravel())
    turns = 2 * math.pi / 9 * np.arange(9)
    poses = np.array([(x, y, turn) for x, y in centers for turn in turns])
    np.testing.assert_array_equal(p.log_p.ravel(), model.log_likelihood(poses, ranges))
    np.testing.assert_allclose(p.poses(rows[:, :, None] // 2, cols[:, :, None] // 2, np.arange(9)), poses, atol=1e-9)
    probability = np.exp(p.log_p.astype(np.float64) - p.log_p.max())
    probability /= probability.sum()
    np.testing.assert_allclose(p.probability, probability, atol=1e-12)
    np.testing.assert_allclose(p.marginal, probability.sum(axis=2), atol=1e-12)
    assert p.entropy == pytest.approx(-(probability * np.log(np.where(probability > 0, probability, 1))).sum())
    assert p.log_evidence == pytest.approx(np.log(np.exp(p.log_p.astype(float)).mean()), rel=1e-5)


def test_free_positions_alone_and_a_scan_that_says_nothing():
    grid = room()
    model = gs.LikelihoodFieldModel(grid, SCANNER, backend="numpy")
    p = gs.pose_likelihood(model, np.full(13, np.nan), resolution=0.2, headings=4, positions="free")
    np.testing.assert_array_equal(np.isnan(p.log_p), np.repeat(~grid.free[:, :, None], 4, axis=2))
    assert p.entropy == pytest.approx(math.log(4 * grid.free.sum()))
    assert p.log_evidence == pytest.approx(0.0)


@pytest.mark.parametrize("shape", [(1, 9), (9, 1), (1, 1), (7, 10), (8, 12)])
@pytest.mark.parametrize("step", [1, 2, 3, 4, 20])
@pytest.mark.parametrize("content", ["free", "mixed", "unknown", "full"])
def test_positions_lie_on_the_map_and_near_all_free_cells(shape, step, content):
    cells = np.full(shape, {"free": 0, "mixed": 0, "unknown": -1, "full": 100}[content])
    if content == "mixed":
        cells[np.random.default_rng(sum(shape)).random(shape) < 0.6] = 100
    grid = gs.OccupancyGrid(cells, 0.5, (3.0, -2.0, 0.7))
    model = gs.LikelihoodFieldModel(grid, gs.Scanner([0.0, 1.0], 4.0), backend="numpy")
    tiles = {(row // step, col // step) for row, col in zip(*np.nonzero(grid.free), strict=True)}
    for positions in ("all", "free"):
        p = gs.pose_likelihood(model, [1.0, 1.5], resolution=0.5 * step, headings=3, positions=positions)
        rows, cols = np.nonzero(~np.isnan(p.log_p).all(axis=2))
        assert len(rows) == p.log_p[..., 0].size if positions == "all" else set(zip(rows, cols, strict=True)) == tiles
        col, row = np.floor(grid.world_to_cells(p.poses(rows, cols, 0)[:, :2])).astype(int).T
        np.testing.assert_array_equal(np.stack([row // step, col // step]), np.stack([rows, cols]))
        assert p.probability.sum() == pytest.approx(1.0 if len(rows) else 0.0)
    tiles, cells = np.stack([rows, cols], axis=1), np.stack([row, col], axis=1)
    middles = tiles * step + np.minimum(step, np.array(shape) - tiles * step) // 2
    for tile, middle, cell in zip(tiles, middles, cells, strict=True):
        squared = [np.sum((free - middle) ** 2) for free in np.argwhere(grid.free) if (free // step == tile).all()]
        assert grid.free[tuple(cell)] and np.sum((cell - middle) ** 2) == min(squared)
    assert p.log_p.shape[:2] == tuple(-(-size // step) for size in shape)


def test_modes_are_local_maxima():
    cells = np.pad(np.zeros((20, 40), int), 1, constant_values=100)
    grid = gs.OccupancyGrid(cells, 0.1)
    model = gs.LikelihoodFieldModel(grid, SCANNER, gs.LikelihoodFieldParameters(sigma_hit=0.1), backend="numpy")
    pose = np.array([1.25, 0.85, 0.0])
    ranges = gs.BeamModel(grid, SCANNER, backend="numpy").expected_ranges(pose[None])[0]
    p = gs.pose_likelihood(model, ranges, resolution=0.1, headings=36)
    poses, log_p = p.modes(2, radius=0.6, angle=0.6)
    assert log_p[0] == p.log_p.max() and log_p[0] >= log_p[1]
    # A rectangle looks the same from the other side.
    assert np.abs(poses[:, 0] + poses[::-1, 0] - 4.2).max() < 0.25
    assert abs(abs(math.remainder(poses[0, 2] - poses[1, 2], 2 * math.pi)) - math.pi) < 0.2
    many, values = p.modes(30)
    assert (np.diff(values) <= 0).all() and len(many) == len(values) > 2
    assert len(p.modes(1)[1]) == 1


def test_impossible_scans_have_no_modes():
    grid = gs.OccupancyGrid(np.zeros((3, 3), int), 1.0)
    parameters = gs.BeamParameters(z_hit=1.0, z_short=0.0, z_max=0.0, z_rand=0.0, sigma_hit=1e-4)
    model = gs.BeamModel(grid, gs.Scanner([0.0], range_max=4.0), parameters, backend="numpy")
    p = gs.pose_likelihood(model, [1.0], resolution=1.0, headings=2)
    if np.isneginf(p.log_p).all():
        assert p.entropy == 0 and p.log_evidence == -np.inf and p.marginal.sum() == 0 and len(p.modes()[1]) == 0
    else:
        assert np.isfinite(p.log_evidence)


def test_pictures_are_written(tmp_path):
    model = gs.LikelihoodFieldModel(room(), SCANNER, backend="numpy")
    p = gs.pose_likelihood(model, np.full(13, 1.0), resolution=0.4, headings=8, positions="free")
    p.plot(tmp_path / "map.png")
    assert (tmp_path / "map.png").read_bytes()[:4] == b"\x89PNG"
    ax = gs.plots.new_figure(4.0, 3.0).subplots()
    best = np.nan_to_num(p.log_p, nan=-np.inf).max(axis=2)
    image = gs.plots.draw_pose_likelihood(ax, p, depth=5.0).get_array()
    assert image.argmax() == best.argmax() and image.max() == 0 and image.min() >= -5


def test_fields_of_maps_are_drawn():
    ax = gs.plots.new_figure(4.0, 3.0).subplots()
    grid = room()
    field = gs.plots.draw_likelihood_field(ax, grid).get_array()
    np.testing.assert_array_equal(field == field.max(), grid.occupied)


def test_too_many_poses_are_refused():
    model, ranges = gs.LikelihoodFieldModel(room(), SCANNER, backend="numpy"), np.ones(13)
    with pytest.raises(ValueError, match=r"^resolution: there must be at most"):
        gs.pose_likelihood(model, ranges, resolution=0.2, headings=1 << 22)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("headings", [36, 60])
def test_modes_are_refined_between_positions_and_headings(headings):
    """The refined pose of a narrow beam model is the true one, far likelier than the best of a coarse lattice."""
    grid, random = gs.worlds.building(size=(12.0, 10.0), seed=1), np.random.default_rng(2)
    scanner = gs.Scanner(np.linspace(-1.5, 1.5, 31), range_max=10.0)
    model = gs.BeamModel(grid, scanner, gs.BeamParameters(sigma_hit=0.03), backend="numpy")
    truth = np.array(gs.worlds.free_pose(grid, random))
    ranges = model.expected_ranges(truth[None])[0]
    lattice, tiles = prepare_tiles(model, ranges, resolution=0.2, headings=headings, positions="free")
    assert list(tiles)[-1] == 1.0
    poses, log_p, gain = refine_modes(model, ranges, lattice, 3)
    assert np.hypot(*(poses[0] - truth)[:2]) < 0.03 and abs(poses[0, 2] - wrapped(truth[2])) < 0.02
    assert gain > 3 and log_p[0] - gain == pytest.approx(np.nanmax(lattice.log_p), abs=1e-3)
    assert (np.diff(log_p) <= 0).all() and len(poses) <= 3
    apart = np.hypot(*(poses[1:] - poses[0])[:, :2].T), np.abs(wrapped(poses[1:, 2] - poses[0, 2]))
    assert ((apart[0] > 0.5) | (apart[1] > 0.26)).all()


def test_headings_of_modes_are_in_the_usual_interval():
    """A robot that looks back has the heading pi, not -pi."""
    model = gs.LikelihoodFieldModel(gs.OccupancyGrid([[100, 0, 0]], 1.0), gs.Scanner([0.0], 9.0), backend="numpy")
    poses, _ = gs.pose_likelihood(model, [1.9], resolution=1.0, headings=4).modes(1)
    assert poses[0, 2] == np.pi
