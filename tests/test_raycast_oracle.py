"""The exact caster against walks in rational arithmetic, against shapely, and under laws that need no oracle."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import pytest
import shapely
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from oracles import Hit, Ray, backward_error_is_small, fraction_walk, walk, world_ray

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.prepare import quadrant_squares

LAST_FLOAT32 = 1 - 2.0**-24
FRACTIONS = (0.0, 0.25, 0.5, 0.75, LAST_FLOAT32)
PRECISIONS = ("float64", "float32")
# The rules of float32: cells, cells and radians. In float64 the same rule, near its own rounding.
FLOAT32_CELLS, FLOAT32_MOVE, FLOAT32_TURN = 1e-3, 1e-4, 1e-6
FLOAT64_RELATIVE, FLOAT64_MOVE, FLOAT64_TURN = 1e-12, 1e-13, 1e-15


@dataclass(frozen=True, eq=False)
class Scene:
    """Rays in cell units. Every number is a float32, so both precisions are asked exactly the same."""

    occupied: np.ndarray
    cell: np.ndarray
    frac: np.ndarray
    direction: np.ndarray
    limit: float
    outside_occupied: bool = False
    grazes: bool = True

    def ray(self, i: int) -> Ray:
        (x, y), frac, direction = self.cell[i].tolist(), self.frac[i].tolist(), self.direction[i].tolist()
        return Ray((x, y), (frac[0], frac[1]), (direction[0], direction[1]), self.limit)

    @functools.cached_property
    def exact(self) -> np.ndarray:
        """The walk's ranges, correctly rounded."""
        cells = self.occupied.tolist()
        return np.array([walk(cells, self.ray(i), self.outside_occupied).t for i in range(len(self.cell))])


@functools.cache
def cast(scene: Scene, backend: str, precision: str) -> np.ndarray:
    """The kernel's ranges in cells; poses carry the direction as their heading, the one ray is along it."""
    device, real = get_backend(backend), np.dtype(precision)
    rows, cols = scene.occupied.shape
    flags = {"FLOAT64"} if precision == "float64" else set()
    flags |= {"OUTSIDE_OCCUPIED"} if scene.outside_occupied else set()
    flags |= {"ORIGINS_OUTSIDE"} if not ((scene.cell >= 0) & (scene.cell < (cols, rows))).all() else set()
    pose = np.concatenate([scene.frac, scene.direction], axis=1)
    count = len(pose)
    squares = quadrant_squares(device, scene.occupied)
    cell, pose = device.upload(scene.cell.astype(np.int32)), device.upload(pose.astype(real))
    rays, ranges = device.upload(np.array([[1.0, 0.0]], real)), device.empty(count, real)
    device.compile("cast_ranges", frozenset(flags))(
        (1, count), squares, cell, pose, rays, ranges, rows, cols, count, 1, 0, 0.0, 0.0, scene.limit, 1.0, scene.limit
    )
    return device.download(ranges, np.empty(count, real))


def as_float32(values: np.ndarray) -> np.ndarray:
    return values.astype(np.float32).astype(np.float64)


def some_map(rng: np.random.Generator, density: float | None = None, largest: int = 40) -> np.ndarray:
    rows, cols = rng.integers(1, largest + 1, 2)
    return rng.random((rows, cols)) < (rng.choice([0.01, 0.05, 0.2]) if density is None else density)


def some_cells(rng: np.random.Generator, occupied: np.ndarray, count: int, beyond: int = 0) -> np.ndarray:
    rows, cols = occupied.shape
    return np.stack([rng.integers(-beyond, n + beyond, count) for n in (cols, rows)], axis=1)


def unit(angle: np.ndarray) -> np.ndarray:
    return as_float32(np.stack([np.cos(angle), np.sin(angle)], axis=-1))


def random_scenes(rng: np.random.Generator) -> list[Scene]:
    """Anything at all, origins outside included."""
    scenes = []
    for number in range(10):
        occupied = some_map(rng)
        frac = rng.integers(0, 1 << 24, (2500, 2)) / (1 << 24)
        direction = unit(rng.uniform(-np.pi, np.pi, 2500))
        cell = some_cells(rng, occupied, 2500, beyond=0 if number % 2 else 6)
        limit = float(rng.choice([3.75, 20, 100]))
        scenes.append(Scene(occupied, cell, frac, direction, limit, number % 4 == 2))
    return scenes


def lattice_scenes(rng: np.random.Generator) -> list[Scene]:
    """Origins on edges and corners, directions of small rational slope: many rays run exactly through corners."""
    scenes = []
    for number in range(10):
        occupied = some_map(rng)
        most = 8 if number % 3 else 32
        direction = rng.integers(-most, most + 1, (2000, 2)) / most
        direction[(direction == 0).all(axis=1)] = (1, 0)
        frac = rng.choice(FRACTIONS, (2000, 2))
        cell = some_cells(rng, occupied, 2000, beyond=4 * (number % 2))
        scenes.append(Scene(occupied, cell, frac, direction, float(rng.choice([4, 7.5, 60])), number % 4 == 3))
    return scenes


def axis_scenes(rng: np.random.Generator) -> list[Scene]:
    """Rays along the axes, on edges as well as off them; -0 is a direction component too."""
    scenes = []
    for number in range(6):
        occupied = some_map(rng)
        direction = np.array([(1, 0), (-1, 0), (0, 1), (0, -1), (1, -0.0), (-0.0, -1)])[rng.integers(0, 6, 2500)]
        frac = rng.choice([*FRACTIONS, 2.0**-24, 2.0**-140], (2500, 2))
        cell = some_cells(rng, occupied, 2500, beyond=5 * (number % 2))
        scenes.append(Scene(occupied, cell, frac, direction, float(rng.choice([2, 5.5, 60])), number == 3, False))
    return scenes


def diagonal_scenes(rng: np.random.Generator) -> list[Scene]:
    """Exactly 45 degrees and slopes of a power of two, in maps of walls that touch at corners only."""
    scenes = []
    for number in range(8):
        occupied = np.zeros((32, 32), bool)
        for _ in range(6):
            start, length = rng.integers(0, 24, 2), rng.integers(2, 9)
            for i in range(length):
                occupied[start[1] + (i if number % 2 else length - i), start[0] + i] = True
        occupied |= rng.random(occupied.shape) < 0.02
        speed = as_float32(rng.choice([1.0, 0.5, math.sqrt(0.5), 0.3, 2.0], 2500))
        slope = rng.choice([1.0, 1.0, 0.5, 2.0], 2500)
        direction = np.stack([speed, speed * slope], axis=1) * rng.choice([-1, 1], (2500, 2))
        frac = rng.choice([0.0, 0.5, 0.25, 0.75], (2500, 2))
        cell = some_cells(rng, occupied, 2500, beyond=3 * (number % 3))
        scenes.append(Scene(occupied, cell, frac, direction, 90.0, number == 3, False))
    return scenes


def tiny_component_scenes(rng: np.random.Generator) -> list[Scene]:
    """Direction components that are denormal, near the least that is told from zero, or merely small."""
    scenes = []
    sizes = as_float32(np.array([1e-45, 1e-40, 9e-31, 1.1e-30, 1e-20, 1e-8, 3e-7]))
    for number in range(4):
        occupied = some_map(rng)
        small = rng.choice(sizes, 2000) * rng.choice([-1, 1], 2000)
        large = rng.choice([-1.0, 1.0], 2000)
        direction = np.stack([large, small] if number % 2 else [small, large], axis=1)
        frac = rng.choice([*FRACTIONS, 2.0**-24, 2.0**-140], (2000, 2))
        cell = some_cells(rng, occupied, 2000, beyond=number)
        scenes.append(Scene(occupied, cell, frac, direction, 50.0))
    return scenes


def small_map_scenes(rng: np.random.Generator) -> list[Scene]:
    """1 x 1, 1 x N, N x 1, empty and full maps."""
    scenes = []
    for shape in ((1, 1), (1, 30), (30, 1), (12, 9)):
        for density in (0.0, 0.1, 1.0):
            for outside_occupied in (False, True):
                occupied = rng.random(shape) < density
                direction = unit(rng.integers(0, 16, 600) * (np.pi / 8))
                frac, cell = rng.choice(FRACTIONS, (600, 2)), some_cells(rng, occupied, 600, beyond=2)
                scenes.append(Scene(occupied, cell, frac, direction, 12.0, outside_occupied))
    return scenes


def limit_scenes(rng: np.random.Generator) -> list[Scene]:
    """A wall exactly at the limit, one ulp of float32 before it and one behind it."""
    scenes = []
    occupied = np.zeros((20, 20), bool)
    occupied[:, 15] = occupied[15, :] = True
    for limit in (4.0, 4.5, 6.0, 12.0):
        for ulp in (-1, 0, 1):
            cell = rng.integers(2, 15, (400, 2))
            direction = np.array([(1.0, 0.0), (0.0, 1.0), (0.5, 0.5), (1.0, 0.25)])[rng.integers(0, 4, 400)]
            frac = rng.choice([0.0, 0.5], (400, 2))
            moved = float(np.nextafter(np.float32(limit), np.float32(limit + ulp)))
            scenes.append(Scene(occupied, cell, frac, direction, moved, False, False))
    return scenes


def corner_scenes(rng: np.random.Generator) -> list[Scene]:
    """Rays aimed at corners of cells, within a few units of the last place of float32."""
    scenes = []
    for number in range(6):
        occupied = some_map(rng, 0.08, 30)
        cell = some_cells(rng, occupied, 1500)
        frac = rng.integers(0, 1 << 24, (1500, 2)) / (1 << 24)
        corner = np.stack([rng.integers(0, n + 1, 1500) for n in occupied.shape[::-1]], axis=1)
        to = corner - cell - frac
        direction = as_float32(to / np.maximum(np.hypot(*to.T), 1e-6)[:, None])
        direction = direction * (1 + rng.integers(-2, 3, (1500, 2)) * 2.0**-24)
        scenes.append(Scene(occupied, cell, frac, as_float32(direction), 60.0, number == 5))
    return scenes


FAMILIES = {
    "random": random_scenes,
    "lattice": lattice_scenes,
    "axes": axis_scenes,
    "diagonals": diagonal_scenes,
    "tiny components": tiny_component_scenes,
    "small maps": small_map_scenes,
    "limits": limit_scenes,
    "corners": corner_scenes,
}


@functools.cache
def scenes_of(family: str) -> list[Scene]:
    return FAMILIES[family](np.random.default_rng([2005, *family.encode()]))


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
def test_every_backend_has_the_bits_of_numpy(family, backend, precision):
    bits = np.dtype(precision).str.replace("f", "u")
    for scene in scenes_of(family):
        expected, found = cast(scene, "numpy", precision), cast(scene, backend, precision)
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


# ---------------------------------------------------------------------------------------------------- laws


MAPS = st.integers(0, 2**32 - 1)
LAWS = settings(
    max_examples=25, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def drawn(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A map, poses off its lattice, and bearings."""
    rng = np.random.default_rng(seed)
    cells = np.where(rng.random(rng.integers(1, 25, 2)) < rng.choice([0.02, 0.1]), 100, 0)
    poses = np.column_stack([*(rng.uniform(-2, n + 2, 12) for n in cells.shape[::-1]), rng.uniform(-4, 4, 12)])
    return cells, poses, rng.uniform(-np.pi, np.pi, 6)


def ranges(cells, poses, bearings, backend, origin=(0.0, 0.0, 0.0), resolution=1.0) -> np.ndarray:
    grid = gs.OccupancyGrid(cells, resolution, origin)
    return gs.RayCaster(grid, 30.0 * resolution, backend=backend, precision="float64").cast(poses, bearings)


@LAWS
@given(MAPS)
def test_turning_map_and_poses_by_a_right_angle(backend, seed):
    cells, poses, bearings = drawn(seed)
    turned = np.column_stack([cells.shape[0] - poses[:, 1], poses[:, 0], poses[:, 2] + np.pi / 2])
    found = ranges(np.rot90(cells, -1), turned, bearings, backend)
    np.testing.assert_allclose(found, ranges(cells, poses, bearings, backend), rtol=1e-9, atol=1e-9)


@LAWS
@given(MAPS, st.floats(-7, 7), st.sampled_from([0.0, 1e3, 5e6]))
def test_turning_map_and_poses_by_the_yaw_of_the_origin(backend, seed, yaw, far):
    cells, poses, bearings = drawn(seed)
    cos, sin, (x, y, theta) = math.cos(yaw), math.sin(yaw), poses.T
    origin = (far, -far, yaw)
    moved = np.column_stack([origin[0] + cos * x - sin * y, origin[1] + sin * x + cos * y, theta + yaw])
    found = ranges(cells, moved, bearings, backend, origin)
    close = 1e-9 if far == 0 else 1e-5
    wrong = np.abs(found - ranges(cells, poses, bearings, backend)) > close
    assert not wrong.any() or (far > 0 and all_backward(cells, poses, bearings, found, wrong, 1e-8 if far else 0))


def all_backward(cells, poses, bearings, found, wrong, move) -> bool:
    return all(
        backward_error_is_small(
            (cells >= 65).tolist(),
            world_ray(poses[n], bearings[k], origin=(0, 0, 0), resolution=1.0, range_max=30.0),
            found[n, k],
            move=move,
            turn=1e-12,
            tolerance=1e-6,
        )
        for n, k in np.argwhere(wrong)
    )


@LAWS
@given(MAPS)
def test_mirror(backend, seed):
    cells, poses, bearings = drawn(seed)
    mirrored = poses * [1, -1, -1] + [0, cells.shape[0], 0]
    found = ranges(cells[::-1], mirrored, -bearings, backend)
    np.testing.assert_allclose(found, ranges(cells, poses, bearings, backend), rtol=1e-9, atol=1e-9)


@LAWS
@given(MAPS, st.integers(0, 300), st.integers(0, 300))
def test_shift(backend, seed, dx, dy):
    """A wider map of free cells around the same walls, the origin moved accordingly."""
    cells, poses, bearings = drawn(seed)
    wide = np.pad(cells, ((dy, 3), (dx, 5)))
    found = ranges(wide, poses + np.array([dx, dy, 0]), bearings, backend)
    np.testing.assert_allclose(found, ranges(cells, poses, bearings, backend), rtol=1e-9, atol=1e-9)
    found = ranges(wide, poses, bearings, backend, origin=(-dx, -dy, 0.0))
    np.testing.assert_allclose(found, ranges(cells, poses, bearings, backend), rtol=1e-9, atol=1e-9)


@LAWS
@given(MAPS, st.sampled_from(PRECISIONS), st.booleans())
def test_a_wall_lengthens_no_range(backend, seed, precision, on_lattice):
    """Exactly, wherever the ray starts: the same ray in a map with one more wall."""
    cells, poses, bearings = drawn(seed)
    if on_lattice:
        poses, bearings = np.round(poses * 4) / 4, np.arange(8) * (np.pi / 4)
    rng = np.random.default_rng(seed)
    more = cells.copy()
    more[tuple(rng.integers(0, n) for n in cells.shape)] = 100
    before, after = (
        gs.RayCaster(gs.OccupancyGrid(c, 1.0), 30.0, backend=backend, precision=precision).cast(poses, bearings)
        for c in (cells, more)
    )
    assert (after <= before).all()


@LAWS
@given(MAPS, st.integers(-3, 3))
def test_whole_turns_do_not_matter(backend, seed, turns):
    cells, poses, bearings = drawn(seed)
    found = ranges(cells, poses + np.array([0, 0, 2 * np.pi * turns]), bearings, backend)
    np.testing.assert_allclose(found, ranges(cells, poses, bearings, backend), rtol=1e-9, atol=1e-9)


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
