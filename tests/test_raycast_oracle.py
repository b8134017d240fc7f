"""The exact caster against walks in rational arithmetic and against shapely."""

from __future__ import annotations

import dataclasses
import functools
import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import pytest
import shapely
from oracles import Hit, Ray, backward_error_is_small, fraction_walk, walk, world_ray
from raycast_scenes import (
    FAMILIES,
    FLOAT32_CELLS,
    FLOAT32_MOVE,
    FLOAT32_TURN,
    FLOAT64_MOVE,
    FLOAT64_RELATIVE,
    FLOAT64_TURN,
    LAST_FLOAT32,
    PRECISIONS,
    Scene,
    as_float32,
    cast,
    scenes_of,
    unit,
)

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.reference.ray import crossed
from gpusense.tolerances import differing


def test_there_are_enough_rays():
    assert sum(len(scene.cell) for family in FAMILIES for scene in scenes_of(family)) >= 100_000


@pytest.mark.parametrize("family", FAMILIES)
def test_integer_walk_is_the_walk_in_fractions(family):
    for scene in scenes_of(family)[::2]:
        for i in range(0, len(scene.cell), 40):
            exact = fraction_walk(scene.occupied, scene.ray(i), scene.outside_occupied)
            assert scene.exact[i] == (scene.limit if exact is None else float(exact))


@pytest.mark.parametrize("family", FAMILIES)
def test_float64_is_the_rational_walk(family, backend):
    for scene in scenes_of(family):
        found = cast(scene, backend, "float64")
        wrong = np.flatnonzero(np.abs(found - scene.exact) > FLOAT64_RELATIVE * scene.exact)
        if scene.grazes:
            wrong = unexplained(scene, found, wrong, FLOAT64_MOVE, FLOAT64_TURN, FLOAT64_RELATIVE)
        assert not len(wrong), [(scene.ray(i), scene.outside_occupied, found[i], scene.exact[i]) for i in wrong[:3]]


@pytest.mark.parametrize("family", FAMILIES)
def test_float32_is_the_rational_walk_of_a_ray_near_by(family):
    for scene in scenes_of(family):
        found = cast(scene, "numpy", "float32").astype(np.float64)
        wrong = np.flatnonzero(np.abs(found - scene.exact) > FLOAT32_CELLS)
        wrong = unexplained(scene, found, wrong, FLOAT32_MOVE, FLOAT32_TURN, FLOAT32_CELLS)
        assert not len(wrong), [(scene.ray(i), scene.outside_occupied, found[i], scene.exact[i]) for i in wrong[:3]]


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("sectors", [1, 2, 4])
def test_every_backend_has_the_bits_of_numpy_for_any_number_of_sectors(family, backend, precision, sectors):
    bits = np.dtype(precision).str.replace("f", "u")
    for scene in scenes_of(family):
        expected = cast(scene, "numpy", precision)
        # Vectors too, where the device has them.
        for wide in (False, True) if get_backend(backend).info.lanes > 1 else (False,):
            found = cast(scene, backend, precision, sectors, wide=wide)
            wrong = np.flatnonzero(expected.view(bits) != found.view(bits))
            assert not len(wrong), [(scene.ray(i), found[i], expected[i]) for i in wrong[:3]]


def unexplained(
    scene: Scene, found: np.ndarray, suspects: np.ndarray, move: float, turn: float, tolerance: float
) -> list[int]:
    """Rays whose range is no near-by ray's either."""
    cells = scene.occupied.tolist()
    return [
        i
        for i in suspects
        if not backward_error_is_small(
            cells, scene.ray(i), float(found[i]), move=move, turn=turn, tolerance=tolerance,
            outside_occupied=scene.outside_occupied,
        )
    ]  # fmt: skip


def test_a_diagonal_pair_of_walls_never_leaks(backend):
    """Neither pair of diagonal neighbours lets a ray through their common corner, from any side."""
    for pair in (((5, 5), (6, 6)), ((5, 6), (6, 5))):
        occupied = np.zeros((12, 12), bool)
        for row, col in pair:
            occupied[row, col] = True
        for sign_x, sign_y in ((1, 1), (-1, 1), (1, -1), (-1, -1)):
            starts = np.arange(1, 5)
            cell = np.stack([6 - sign_x * starts, 6 - sign_y * starts], axis=1)
            scene = Scene(occupied, cell, np.zeros((4, 2)), np.tile([0.5 * sign_x, 0.5 * sign_y], (4, 1)), 30.0)
            for precision in PRECISIONS:
                along_the_pair = (pair[0] == (5, 5)) == (sign_x == sign_y)
                expected = 2.0 * (starts - 1 if along_the_pair else starts)
                np.testing.assert_array_equal(cast(scene, backend, precision), expected)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_no_pair_of_walls_leaks_at_any_slope(precision, backend):
    """Rays aimed at the common corner of two walls as exactly as floats can: however they round, a wall stops them."""
    rng = np.random.default_rng(13)
    for number in range(40):
        sign = rng.choice([-1, 1], 2)
        occupied = np.zeros((41, 41), bool)
        # The corner is (20, 20). The cells before and behind it on the way are free, the two beside it are walls.
        occupied[20 if sign[1] < 0 else 19, 20 if sign[0] > 0 else 19] = True
        occupied[20 if sign[1] > 0 else 19, 20 if sign[0] < 0 else 19] = True
        if number % 2:
            away = rng.integers(1, 20, (100, 2)).astype(float)
            direction = away / 2.0 ** rng.integers(5, 8, (100, 1))
        else:
            away = rng.integers(1, 20 << 16, (100, 2)) / (1 << 16)
            direction = as_float32(away / np.hypot(*away.T)[:, None])
        origin = 20 - sign * away
        cell = np.floor(origin).astype(int)
        scene = Scene(occupied, cell, origin - cell, direction * sign, 2000.0)
        corner = np.hypot(*away.T) / np.hypot(*direction.T)
        found = cast(scene, backend, precision)
        assert (found <= corner * (1 + 1e-5)).all(), scene.ray(int(np.argmax(found - corner)))


# ------------------------------------------------------------------------------------------ through RayCaster.cast


WORLDS = {
    "plain": (0.05, (0.0, 0.0, 0.0)),
    "millimetres": (0.001, (0.3, -0.2, 0.0)),
    "hundred metres": (100.0, (-500.0, 900.0, 0.4)),
    "yaw": (0.05, (-3.0, 2.0, 2.5)),
}
CELLS_FAR = 30.5


@dataclass(frozen=True)
class World:
    """A grid with unknown cells, poses all around it, and the exact casts."""

    grid: gs.OccupancyGrid
    poses: np.ndarray
    bearings: np.ndarray
    cells: list[list[bool]]
    rays: dict[tuple[int, int], Ray]
    exact: dict[tuple[int, int], Hit]


@functools.cache
def world(name: str, unknown: str, outside: str) -> World:
    resolution, origin = WORLDS[name]
    rng = np.random.default_rng([7, *name.encode()])
    grid = gs.OccupancyGrid(rng.choice([0, 100, -1, 40], (25, 36), p=[0.86, 0.06, 0.04, 0.04]), resolution, origin)
    x, y = (n * rng.uniform(-0.2, 1.2, 200) for n in (grid.width, grid.height))
    cos, sin = math.cos(origin[2]), math.sin(origin[2])
    theta = rng.uniform(-10, 10, 200)
    poses = np.stack([origin[0] + cos * x - sin * y, origin[1] + sin * x + cos * y, theta], axis=1)
    bearings = rng.uniform(-np.pi, np.pi, 8)
    stops = (grid.cells >= 65) | ((grid.cells < 0) & (unknown == "occupied"))
    rays = {
        (n, k): world_ray(poses[n], bearings[k], origin=origin, resolution=resolution, range_max=CELLS_FAR * resolution)
        for n, k in np.ndindex(len(poses), len(bearings))
    }
    exact = {index: walk(stops.tolist(), ray, outside == "occupied") for index, ray in rays.items()}
    return World(grid, poses, bearings, stops.tolist(), rays, exact)


@pytest.mark.parametrize("name", WORLDS)
@pytest.mark.parametrize(("unknown", "outside"), [("free", "free"), ("occupied", "free"), ("free", "occupied")])
@pytest.mark.parametrize("precision", PRECISIONS)
def test_casts_of_a_world(name, unknown, outside, precision, backend):
    w = world(name, unknown, outside)
    resolution = w.grid.resolution
    caster = gs.RayCaster(
        w.grid, CELLS_FAR * resolution, backend=backend, precision=precision, unknown=unknown, outside=outside
    )
    found = caster.cast(w.poses, w.bearings).astype(np.float64) / resolution
    for index, ray in w.rays.items():
        hit, r = w.exact[index], found[index]
        tolerance, move, turn = FLOAT32_CELLS, FLOAT32_MOVE, FLOAT32_TURN
        if precision == "float64":
            tolerance, move, turn = forward_error(ray, hit), 1e-12, 1e-15
        assert abs(r - hit.t) <= tolerance or backward_error_is_small(
            w.cells, ray, r, move=move, turn=turn, tolerance=tolerance, outside_occupied=outside == "occupied"
        ), (index, ray, r, hit)


def forward_error(ray: Ray, exact: Hit) -> float:
    """Float64: 1e-12 of the range, and what a rounded position and direction do to a ray that meets a wall aslant."""
    normal = {"x": ray.direction[0], "y": ray.direction[1]}.get(exact.face[2] if exact.face else "", 1)
    size = 2e-15 * (1 + max(abs(ray.cell[0]), abs(ray.cell[1])))
    return 1e-12 * exact.t + (size + 1e-15 * exact.t) / max(abs(float(normal)), 1e-12)


@pytest.mark.parametrize("theta", [1e6, -1e6, 123456.789])
def test_large_headings(backend, theta):
    """The heading is reduced by its true value modulo 2 pi, not by a rounded one."""
    rng = np.random.default_rng(3)
    occupied = rng.random((30, 30)) < 0.05
    poses = np.column_stack([rng.uniform(0, 30, (100, 2)), theta + rng.uniform(-3, 3, 100)])
    grid = gs.OccupancyGrid(occupied * 100, 1.0)
    found = gs.RayCaster(grid, 40.0, backend=backend, precision="float64").cast(poses, [0.0, 1.0])
    for n, k in np.ndindex(found.shape):
        ray = world_ray(poses[n], [0.0, 1.0][k], origin=(0, 0, 0), resolution=1.0, range_max=40.0)
        exact = walk(occupied.tolist(), ray)
        assert abs(found[n, k] - exact.t) <= forward_error(ray, exact)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_long_corridors(backend, precision):
    """20 000 cells along an axis and aslant: the far wall at its distance, whatever lies beside the way."""
    length = 20_000
    occupied = np.zeros((9, length), bool)
    occupied[:, -1] = True
    occupied[0, 9::10] = occupied[-1, 4::10] = True
    rng = np.random.default_rng(1)
    frac = rng.integers(0, 1 << 24, (200, 2)) / (1 << 24)
    slope = as_float32(np.where(np.arange(200) % 2, rng.uniform(-1e-4, 1e-4, 200), 0.0))
    cell = np.stack([rng.integers(0, 50, 200), np.full(200, 4)], axis=1)
    scene = Scene(occupied, cell, frac, np.stack([np.ones(200), slope], axis=1), 30_000.0)
    expected = length - 1 - cell[:, 0] - frac[:, 0]
    error = np.abs(cast(scene, backend, precision) - expected)
    assert (error <= (FLOAT32_CELLS if precision == "float32" else FLOAT64_RELATIVE * expected)).all()


# The most cells that a range may have.
MOST = 1 << 20


def rounded(value: Fraction, real: np.dtype) -> Fraction:
    """The number of a precision that is nearest, and even between two; for 0 and positive normal ones."""
    if value == 0:
        return value
    exponent = math.floor(math.log2(value))
    # Next to a power of two the logarithm may be off.
    exponent += (value >= Fraction(2) ** (exponent + 1)) - (value < Fraction(2) ** exponent)
    unit_in_last_place = Fraction(2) ** (exponent - np.finfo(real).nmant)
    return round(value / unit_in_last_place) * unit_in_last_place


@pytest.mark.parametrize("precision", PRECISIONS)
def test_counts_of_boundaries_near_the_longest_range(precision):
    """Those whose rounded distances are below t, or t itself: at such distances and next to them, by fractions."""
    real, rng, count = np.dtype(precision), np.random.default_rng(17), 1500
    speed = np.concatenate(
        [rng.uniform(0.5, 1, count), np.sqrt(np.full(count, 0.5)), 2.0 ** rng.uniform(-20, 0, count)]
    )
    speed = speed.astype(real)
    inv, size = 1 / speed, len(speed)
    a = rng.choice([0, 2.0**-24, 0.25, 0.5, 1 - 2.0**-24, 1], size).astype(real)
    a = np.where(rng.random(size) < 0.5, rng.random(size).astype(real), a)
    most = np.minimum(np.floor(MOST * speed.astype(float)), MOST - 2)
    k = np.maximum(most - rng.integers(0, 1000, size), 0).astype(real)
    near = (k + a) * inv
    for t in (near, np.nextafter(near, real.type(0)), np.nextafter(near, real.type(np.inf)), near + inv / 2):
        t = np.minimum(np.maximum(t, 0), real.type(MOST))
        found = [crossed(t, speed, a, inv, until) for until in (False, True)]
        for i in range(size):
            at, pace, first, inverse = (Fraction(float(v[i])) for v in (t, speed, a, inv))
            low = max(math.floor(at * pace - first) - 2, 0)
            far = [rounded(rounded(n + first, real) * inverse, real) for n in range(low, low + 6)]
            assert far[-1] > at and (low == 0 or far[0] < at)
            assert found[0][i] == low + sum(one < at for one in far)
            assert found[1][i] == low + sum(one <= at for one in far)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_origins_nearly_as_far_off_as_a_range_may_be_long(precision, backend):
    """float64 is the rational walk; float32 has the bits of numpy's walk from cell to cell."""
    rng = np.random.default_rng(19)
    occupied = rng.random((50, 60)) < 0.02
    target = rng.uniform((0, 0), (60, 50), (600, 2))
    turn = np.where(np.arange(600) % 3, rng.uniform(-np.pi, np.pi, 600), rng.integers(0, 8, 600) * (np.pi / 4))
    direction = unit(turn)
    away = np.floor(rng.uniform(0.9, 0.9999, 600) * MOST)
    origin = target - direction * away[:, None]
    cell = np.floor(origin).astype(int)
    scene = Scene(occupied, cell, as_float32(np.minimum(origin - cell, LAST_FLOAT32)), direction, float(MOST))
    found = cast(scene, backend, precision)
    assert 100 < np.count_nonzero(found < MOST) < 600
    for sectors in (2, 4):
        assert differing(cast(scene, backend, precision, sectors), found) == 0
    assert differing(found, cast(scene, "numpy", precision)) == 0
    if precision == "float64" and backend == "numpy":
        # The walk begins near the map, at a place on the ray that is exact.
        for i in range(0, 600, 4):
            ray, skipped = scene.ray(i), int(away[i]) - 100
            near = ray.moved(*(skipped * Fraction(d) for d in ray.direction), 0)
            near = dataclasses.replace(near, limit=MOST - skipped)
            assert abs(skipped + walk(occupied.tolist(), near).t - found[i]) <= 1e-9 or backward_error_is_small(
                occupied.tolist(), near, found[i] - skipped, move=1e-9, turn=FLOAT64_TURN, tolerance=1e-9
            )


@pytest.mark.parametrize("precision", PRECISIONS)
def test_the_longest_corridor(precision, backend):
    """A million cells inside the map: counts of boundaries as they were at its begin."""
    length = MOST - 100 if get_backend(backend).info.backend != "numpy" else 100_000
    occupied = np.zeros((3, length), bool)
    occupied[:, -1] = True
    rng = np.random.default_rng(23)
    frac = rng.integers(0, 1 << 24, (60, 2)) / (1 << 24)
    slope = as_float32(np.where(np.arange(60) % 2, rng.uniform(-9e-7, 9e-7, 60), 0.0))
    cell = np.stack([rng.integers(0, 50, 60), np.full(60, 1)], axis=1)
    scene = Scene(occupied, cell, frac, np.stack([np.ones(60), slope], axis=1), float(MOST))
    expected = length - 1 - cell[:, 0] - frac[:, 0]
    found = cast(scene, backend, precision, 2, wide=True)
    assert (np.abs(found - expected) <= np.spacing(expected.astype(precision))).all()


def test_range_max_is_returned_as_it_is(backend):
    grid = gs.OccupancyGrid(np.zeros((4, 4), int), 0.3)
    for range_max in (0.7, 30.1, 1e-3):
        for precision in PRECISIONS:
            caster = gs.RayCaster(grid, range_max, backend=backend, precision=precision)
            found = caster.cast([[0.5, 0.5, 0.3], [-50.0, 3.0, 0.0]], np.linspace(-3, 3, 9))
            assert (found == np.dtype(precision).type(range_max)).all()


def test_all_unknown_map(backend):
    grid = gs.OccupancyGrid(np.full((5, 5), -1), 1.0)
    poses = [[2.5, 2.5, 0.0], [-1.5, 2.5, 0.0]]
    assert gs.RayCaster(grid, 9.0, backend=backend).cast(poses, [0.0]).tolist() == [[9.0], [9.0]]
    caster = gs.RayCaster(grid, 9.0, backend=backend, unknown="occupied")
    assert caster.cast(poses, [0.0, math.pi]).tolist() == [[0.0, 0.0], [1.5, 9.0]]


@pytest.mark.parametrize("heading", [0.0, math.pi / 2, -math.pi / 2, math.pi, 2 * math.pi])
def test_a_ray_along_an_edge_stays_in_its_row(backend, heading):
    """From the lower edge of a cell along that edge: the walls of the rows above and below are told apart."""
    cells = np.zeros((9, 9), int)
    cells[4, 7] = cells[7, 4] = cells[4, 1] = cells[1, 4] = 100
    grid = gs.OccupancyGrid(cells, 1.0)
    for precision in PRECISIONS:
        found = gs.RayCaster(grid, 20.0, backend=backend, precision=precision).cast([[4.5, 4.5, heading]], [0.0])
        assert found[0, 0] == pytest.approx(2.5, abs=1e-6)
        edge = {0.0: (4.5, 4.0), math.pi / 2: (4.0, 4.5), 2 * math.pi: None}.get(heading)
        if edge is not None:
            found = gs.RayCaster(grid, 20.0, backend=backend, precision=precision).cast([[*edge, heading]], [0.0])
            assert found[0, 0] == 2.5


@functools.cache
def shapely_casts() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A map, 20 000 poses, and the distances to the union of the occupied squares."""
    rng = np.random.default_rng(11)
    occupied = rng.random((40, 40)) < 0.04
    rows, cols = np.nonzero(occupied)
    walls = shapely.union_all(shapely.box(cols, rows, cols + 1, rows + 1))
    shapely.prepare(walls)
    starts = rng.uniform(-3, 43, (20_000, 2))
    angles = rng.uniform(-np.pi, np.pi, 20_000)
    ends = starts + 50.0 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    cut = shapely.intersection(shapely.linestrings(np.stack([starts, ends], axis=1)), walls)
    distance = np.nan_to_num(shapely.distance(shapely.points(starts), cut), nan=50.0)
    return occupied, np.column_stack([starts, angles]), np.minimum(distance, 50.0)


def test_against_shapely(backend):
    occupied, poses, expected = shapely_casts()
    caster = gs.RayCaster(gs.OccupancyGrid(occupied * 100, 1.0), 50.0, backend=backend, precision="float64")
    found = caster.cast(poses, [0.0])[:, 0]
    wrong = np.flatnonzero(np.abs(found - expected) > 1e-9)
    for i in wrong:
        ray = world_ray(poses[i], 0.0, origin=(0, 0, 0), resolution=1.0, range_max=50.0)
        for r in (found[i], expected[i]):
            assert backward_error_is_small(occupied.tolist(), ray, r, move=1e-9, turn=1e-12, tolerance=1e-9)
    assert len(wrong) <= 2
