"""The likelihood field against an independent implementation, and float32 look-ups against float64 ones."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.oracles import Field
from support.selection import on_every_backend

import gpusense as gs

PRECISIONS = ("float64", "float32")
RANGE = 12.0
BEARINGS = np.linspace(-np.pi, np.pi, 40, endpoint=False) + 0.013
NAN, INF = math.nan, math.inf

GRIDS = {
    "plain": (0.25, (0.0, 0.0, 0.0)),
    "yaw": (0.25, (-4.0, 3.0, 2.2)),
    "far away": (0.25, (4.5e5, 5.2e6, -0.8)),
    "millimetres": (0.001, (1.0, 2.0, 0.5)),
    "hundred metres": (100.0, (0.0, -3e4, 1.0)),
}
PARAMETERS = {
    "default": {},
    "z_max": {"z_hit": 0.8, "z_max": 0.1, "z_rand": 0.1},
    "no rand": {"z_hit": 1.0, "z_max": 0.0, "z_rand": 0.0},
    "no hit": {"z_hit": 0.0, "z_max": 0.0, "z_rand": 1.0},
    "hardly any rand": {"z_hit": 1.0, "z_max": 0.0, "z_rand": 2.0**-110},
    "only max": {"z_hit": 0.0, "z_max": 1.0, "z_rand": 0.0},
    "tiny sigma": {"sigma_hit": 1e-4},
    "huge sigma": {"sigma_hit": 1e4},
    "short reach": {"max_distance": 0.3},
    "long reach": {"max_distance": 1e3},
}


def scene(resolution: float, origin: tuple[float, float, float], density: float = 0.08, seed: int = 0):
    """Return a grid with unknown cells, and poses in and around it; lengths are in units of 4 cells."""
    rng = np.random.default_rng([seed, int(density * 100)])
    cells = rng.choice([0, 100, -1, 64], (50, 70), p=[0.9 - density, density, 0.05, 0.05])
    grid = gs.OccupancyGrid(cells, resolution, origin)
    x, y = (n * rng.uniform(-0.1, 1.1, 60) for n in (grid.width, grid.height))
    cos, sin = math.cos(origin[2]), math.sin(origin[2])
    poses = np.stack([origin[0] + cos * x - sin * y, origin[1] + sin * x + cos * y, rng.uniform(-9, 9, 60)], axis=1)
    ranges = rng.uniform(0, RANGE, len(BEARINGS))
    ranges[:8] = [NAN, INF, -1.0, 0.0, RANGE, RANGE - 1e-9, -INF, 20.0]
    return grid, poses, ranges * 4 * resolution


def scaled(names: dict[str, float], resolution: float, interpolation: str) -> gs.LikelihoodFieldParameters:
    """Return parameters, also with lengths in units of 4 cells."""
    p = gs.LikelihoodFieldParameters(**names, interpolation=interpolation)
    unit = 4 * resolution
    return p.replace(sigma_hit=p.sigma_hit * unit, max_distance=p.max_distance * unit)


def compare(field: Field, model, poses, ranges, bearings, range_min=0.0) -> None:
    """Compare parts and sums; a beam that ends on an edge up to rounding may take either cell."""
    expected, clear = field.parts(poses, ranges, bearings, range_min)
    log_p, parts = model.log_likelihood(poses, ranges, per_beam=True)
    assert parts.dtype == log_p.dtype == np.dtype(model.precision)
    near = 1e-7 if model.parameters.interpolation == "nearest" else 0.0
    sure = clear > near
    assert sure.mean() > 0.999
    eps = np.finfo(parts.dtype).eps
    p = model.parameters
    with np.errstate(invalid="ignore"):
        error = np.where(parts == expected, 0, np.abs(parts - expected))
    size = 1 + np.abs(np.where(np.isfinite(expected), expected, 0)) + abs(math.log(p.sigma_hit))
    slope = field.parameters.max_distance * field.resolution / p.sigma_hit**2 if p.interpolation == "bilinear" else 0.0
    place = 64 * eps * (4 * RANGE) + 1e-9
    allowed = 16 * eps * size + slope * place
    assert (error <= allowed)[sure].all(), np.argwhere((error > allowed) & sure)[:5]
    with np.errstate(invalid="ignore"):
        total = model.temperature * parts.astype(np.float64).sum(axis=1)
        different = np.where(log_p == total, 0, np.abs(log_p - total))
    finite = np.isfinite(total)
    assert (different[~finite] == 0).all()
    bound = 16 * eps * (1 + np.abs(np.where(np.isfinite(parts), parts, 0)).sum(axis=1))
    assert (different <= bound).all()
    np.testing.assert_array_equal(model.log_likelihood(poses, ranges), log_p)


@pytest.mark.sampled(0.25)
@pytest.mark.parametrize("interpolation", ["nearest", "bilinear"])
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("place", GRIDS)
def test_field_in_every_frame(place, precision, interpolation, backend):
    resolution, origin = GRIDS[place]
    grid, poses, ranges = scene(resolution, origin)
    p = scaled({}, resolution, interpolation)
    range_max = RANGE * 4 * resolution
    mount = (0.8 * resolution, -2.4 * resolution, 0.7)
    scanner = gs.Scanner(BEARINGS, range_max, 0.4 * resolution, mount)
    model = gs.LikelihoodFieldModel(
        grid, scanner, p, backend=backend, precision=precision, unknown="occupied", temperature=0.5
    )
    field = Field((grid.cells >= 65) | (grid.cells < 0), resolution, origin, p, range_max, mount)
    compare(field, model, poses, ranges, BEARINGS, scanner.range_min)


@pytest.mark.sampled(0.15)
@pytest.mark.parametrize("interpolation", ["nearest", "bilinear"])
# The other parameters are host code.
@on_every_backend(
    precision=PRECISIONS,
    name=PARAMETERS,
    on_warp=lambda precision, name: precision == "float32" and name in ("default", "no rand", "z_max"),
)
@pytest.mark.parametrize("specialize", [True, False])
def test_field_of_any_parameters(name, precision, interpolation, specialize, backend):
    resolution, origin = GRIDS["plain"]
    grid, poses, ranges = scene(resolution, origin, seed=1)
    p = scaled(PARAMETERS[name], resolution, interpolation)
    scanner = gs.Scanner(BEARINGS, RANGE)
    model = gs.LikelihoodFieldModel(grid, scanner, p, backend=backend, precision=precision, specialize=specialize)
    field = Field(grid.cells >= 65, resolution, origin, p, RANGE)
    compare(field, model, poses, ranges, BEARINGS)


@pytest.mark.long_on("warp")
@pytest.mark.parametrize("interpolation", ["nearest", "bilinear"])
@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1), (17, 23)])
@pytest.mark.parametrize("filling", [0, 100, -1])
def test_empty_full_and_unknown_maps(shape, filling, interpolation, backend):
    grid = gs.OccupancyGrid(np.full(shape, filling), 0.25)
    rng = np.random.default_rng(5)
    poses = np.column_stack([rng.uniform(-3, 9, (50, 2)), rng.uniform(-4, 4, 50)])
    p = scaled({}, 0.25, interpolation)
    for unknown in ("free", "occupied"):
        stops = (grid.cells >= 65) | ((grid.cells < 0) & (unknown == "occupied"))
        model = gs.LikelihoodFieldModel(
            grid, gs.Scanner(BEARINGS, RANGE), p, backend=backend, precision="float64", unknown=unknown
        )
        field = Field(stops, 0.25, (0, 0, 0), p, RANGE)
        compare(field, model, poses, rng.uniform(0, 5, len(BEARINGS)), BEARINGS)


# ------------------------------------------------------------------------------------ the same cells in float32


def parts_of(precision: str, backend: str, grid, poses, ranges, bearings, sigma: float) -> np.ndarray:
    p = gs.LikelihoodFieldParameters(sigma_hit=sigma, max_distance=40 * grid.resolution)
    model = gs.LikelihoodFieldModel(grid, gs.Scanner(bearings, 1e3), p, backend=backend, precision=precision)
    return model.log_likelihood(poses, ranges, per_beam=True)[1].astype(np.float64)


def differing_cells(grid, poses, ranges, bearings, left: tuple[str, str], right: tuple[str, str]) -> np.ndarray:
    """Return beams with parts that differ by more than a few eps: end points in cells of different distance."""
    sigma = 10 * grid.resolution
    a, b = (parts_of(precision, name, grid, poses, ranges, bearings, sigma) for precision, name in (left, right))
    return np.argwhere(np.abs(a - b) > 32 * np.finfo(np.float32).eps * (1 + np.abs(a)))


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (-3.7, 2.2, 0.3), (4e5, 5e6, 1.0)])
@pytest.mark.parametrize("longest", [5.0, 405.0, 900.0])
def test_float32_look_ups_hit_the_cells_of_float64(origin, longest, backend):
    """Of 40 000 random end points, some hundreds are nearer to an edge than float32 resolves."""
    rng = np.random.default_rng(6)
    grid = gs.OccupancyGrid((rng.random((200, 200)) < 0.1) * 100, 0.05, origin)
    inside = rng.uniform(1, 9, (200, 2))
    cos, sin = math.cos(origin[2]), math.sin(origin[2])
    xy = inside @ np.array([[cos, sin], [-sin, cos]]) + origin[:2]
    poses = np.column_stack([xy, rng.uniform(-1e3, 1e3, 200)])
    ranges, bearings = rng.uniform(0, 5, 200), rng.uniform(-4, 4, 200)
    if longest > 5:
        # Long readings of equally distant poses end in the map.
        poses[:, 0] -= longest * np.cos(poses[:, 2])
        poses[:, 1] -= longest * np.sin(poses[:, 2])
        ranges, bearings = longest + rng.uniform(-4, 4, 200), rng.uniform(-0.004, 0.004, 200)
    wrong = differing_cells(grid, poses, ranges, bearings, ("float64", "numpy"), ("float32", backend))
    assert not len(wrong), (len(wrong), wrong[:3])


def lattice(resolution: float) -> tuple:
    """Return poses and readings in whole quarters of a cell, headings and bearings of whole quarter turns."""
    rng = np.random.default_rng(7)
    grid = gs.OccupancyGrid((rng.random((160, 160)) < 0.15) * 100, resolution)
    theta = np.array([0.0, np.pi / 2, -np.pi / 2, np.pi, 2 * np.pi])[rng.integers(0, 5, 400)]
    poses = np.column_stack([rng.integers(160, 480, (400, 2)) * (resolution / 4), theta])
    ranges = rng.integers(0, 160, 100) * (resolution / 4)
    bearings = np.array([0.0, np.pi / 2, -np.pi / 2, np.pi])[rng.integers(0, 4, 100)]
    return grid, poses, ranges, bearings


@pytest.mark.parametrize("resolution", [0.05, 0.25])
def test_float32_look_ups_on_the_edges_of_cells(resolution, backend):
    """Most of 40 000 end points are on an edge up to the rounding of cosines: their cells are the same."""
    wrong = differing_cells(*lattice(resolution), ("float64", "numpy"), ("float32", backend))
    assert not len(wrong), (len(wrong), wrong[:3])


@pytest.mark.parametrize("resolution", [0.05, 0.25])
@pytest.mark.parametrize("precision", PRECISIONS)
def test_every_backend_chooses_the_same_cells_on_edges(resolution, precision, backend):
    wrong = differing_cells(*lattice(resolution), (precision, "numpy"), (precision, backend))
    assert not len(wrong), (len(wrong), wrong[:3])


def test_an_end_point_just_below_the_cell_of_the_pose(backend):
    """A beam of 1e-9 m to the left, from a cell's left edge, ends in the cell to the left, in both precisions."""
    cells = np.zeros((3, 41), int)
    cells[1, 0] = 100
    grid = gs.OccupancyGrid(cells, 1.0)
    pose, scanner = [[20.0, 1.5, math.pi]], gs.Scanner([0.0], 30.0)
    p = gs.LikelihoodFieldParameters(max_distance=100.0, sigma_hit=5.0)
    for precision in PRECISIONS:
        model = gs.LikelihoodFieldModel(grid, scanner, p, backend=backend, precision=precision)
        found = float(model.log_likelihood(pose, [1e-9])[0])
        expected = math.log(0.9 / (5 * math.sqrt(2 * math.pi)) * math.exp(-((19 / 5) ** 2) / 2) + 0.1 / 30)
        assert found == pytest.approx(expected, rel=1e-5), precision


def test_a_cloud_in_a_map_longer_than_distances_reach(backend):
    """The cloud reaches 1300 of 60 000 cells in a row; all other cells are omitted."""
    cells = np.zeros((1, 60_001), int)
    cells[0, [0, 50_000]] = 100
    grid = gs.OccupancyGrid(cells, 0.05)
    poses = [[2500.025 - 1.0, 0.025, 0.0], [2500.025 - 1.5, 0.025, 0.0]]
    model = gs.LikelihoodFieldModel(grid, gs.Scanner([0.0], 30.0), gs.LikelihoodFieldParameters(), backend=backend)
    expected = np.log(0.9 / (0.2 * math.sqrt(2 * math.pi)) * np.exp(-np.array([0, 2.5**2]) / 2) + 0.1 / 30)
    np.testing.assert_allclose(model.log_likelihood(poses, [1.0]), expected, rtol=1e-5)


def test_a_window_that_fits_is_not_refused_for_its_room_to_move(backend):
    """24 000 cells are within reach; with a margin of half the reach the window would be too long."""
    cells = np.zeros((1, 60_001), int)
    cells[0, 30_000] = 100
    grid = gs.OccupancyGrid(cells, 0.001)
    model = gs.LikelihoodFieldModel(grid, gs.Scanner([0.0], 10.0), gs.LikelihoodFieldParameters(), backend=backend)
    expected = math.log(0.9 / (0.2 * math.sqrt(2 * math.pi)) + 0.1 / 10)
    assert model.log_likelihood([[29.5005, 0.0005, 0.0]], [0.5])[0] == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("shape", [(1, 32_767), (32_767, 1), (3, 20_000)])
def test_distances_of_long_maps(shape, backend):
    """Distances are exact integers up to the limit of int32."""
    obstacles = np.zeros(shape, bool)
    obstacles[0, 0] = True
    rows, cols = np.indices(shape)
    np.testing.assert_array_equal(gs.distance_transform(obstacles, squared=True, backend=backend), rows**2 + cols**2)
