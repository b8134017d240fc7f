"""Every way to find expected ranges: the bits of NumPy on every backend, its own laws, its knobs, tables and files."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from test_raycast_oracle import FAMILIES, Scene, scenes_of

import gpusense as gs
from gpusense import casters, region
from gpusense.backends import get_backend
from gpusense.casters import Bresenham, Caster, Cddt, Dda, Exact, Lookup, March, Window
from gpusense.directional import directional_table
from gpusense.lookup_files import read_lookup, write_lookup
from gpusense.reference import march as march_reference
from gpusense.reference.densities import log_mixture
from gpusense.worlds import building, cloud_uniform

DOCS = Path(__file__).resolve().parents[1] / "docs" / "casters.md"
RANGE = 3.0
KINDS = [
    *(Exact(), Dda(), Bresenham(), March(), March(0.02), March(1.5, "centre")),
    *(Cddt(), Cddt(36, pruned=False), Cddt(7), Lookup(24), Lookup(5)),
]
CROPPED = [kind for kind in KINDS if not kind.whole]
POLICIES = [("free", "free"), ("occupied", "free"), ("free", "occupied"), ("occupied", "occupied")]


def by_name(kind: object) -> str:
    return repr(kind).replace(" ", "") if isinstance(kind, Caster) else str(kind)


def same_bits(found: np.ndarray, expected: np.ndarray) -> None:
    assert found.dtype == expected.dtype and found.shape == expected.shape
    np.testing.assert_array_equal(*(a.view(a.dtype.str.replace("f", "u")) for a in (found, expected)))


@functools.cache
def place() -> tuple[gs.OccupancyGrid, np.ndarray, np.ndarray]:
    """A turned map with unknown cells; poses all over it and around it, many on its lattice; bearings."""
    rng = np.random.default_rng(0)
    cells = rng.choice([0, 100, -1], (40, 56), p=[0.95, 0.03, 0.02])
    grid = gs.OccupancyGrid(cells, 0.1, (1.0, -2.0, 0.4))
    centers = grid.cell_centers(rng.integers(-8, 48, 300), rng.integers(-8, 64, 300))
    poses = np.column_stack([centers + rng.uniform(-0.05, 0.05, centers.shape), rng.uniform(-4, 4, 300)])
    poses[::3, 2] = 0.4 + rng.integers(-4, 5, 100) * (np.pi / 4)
    poses[::6, :2] = centers[::6]
    return grid, poses, np.linspace(-3, 3, 9)


def cast(kind: Caster, backend: str, precision: str, unknown: str, outside: str) -> np.ndarray:
    grid, poses, bearings = place()
    caster = gs.RayCaster(
        grid, RANGE, method=kind, backend=backend, precision=precision, unknown=unknown, outside=outside
    )
    return caster.cast(poses, bearings)


numpy_cast = functools.cache(functools.partial(cast, backend="numpy"))


# ------------------------------------------------------------------------------------------------------ same bits


@pytest.mark.parametrize("kind", KINDS, ids=by_name)
def test_every_backend_has_the_bits_of_numpy(kind, backend):
    for precision, policies in (("float32", POLICIES), ("float64", POLICIES[::3])):
        for unknown, outside in policies:
            case = dict(precision=precision, unknown=unknown, outside=outside)
            same_bits(cast(kind, backend, **case), numpy_cast(kind, **case))


@pytest.mark.parametrize("kind", CROPPED, ids=by_name)
@pytest.mark.parametrize("outside", ["free", "occupied"])
def test_a_cropped_map_has_the_bits_of_the_whole_map(kind, outside, backend, monkeypatch):
    """The window is the least that these poses need, since an earlier cloud chose it; obstacles beyond it are near."""
    rng = np.random.default_rng(1)
    grid = gs.OccupancyGrid(rng.choice([0, 100], (300, 400), p=[0.998, 0.002]), 1.0)
    poses = np.column_stack([rng.uniform(208, 209.5, 150), rng.uniform(158, 159.5, 150), rng.uniform(-3, 3, 150)])
    bearings = np.linspace(-3, 3, 9)
    caster = functools.partial(gs.RayCaster, grid, 20.0, method=kind, outside=outside)
    whole = caster(backend="numpy").cast(poses, bearings)
    monkeypatch.setattr(region, "SMALLEST_CELLS", 100)
    cropped = caster(backend=backend)
    cropped.prepare([[200.5, 150.5, 0.0]])
    before = cropped._caster.map.region
    same_bits(cropped.cast(poses, bearings), whole)
    assert cropped._caster.map.region == before and before.cells < grid.cells.size / 4


@pytest.mark.parametrize("kind", [Exact(), Dda(), Bresenham(), March(), Cddt(36), Lookup(8)], ids=by_name)
def test_origins_far_off_the_map(kind, backend):
    """Up to what a place can be; rays that lead away, or end before the map, are exactly range_max."""
    cells = np.zeros((20, 30), int)
    cells[5:15, 25] = 100
    grid, limit = gs.OccupancyGrid(cells, 1.0), 4e6
    caster = gs.RayCaster(grid, limit, method=kind, backend=backend)
    for far in (1e3, 1e6, 2.2e6, 1e7, 1e9, 1e12):
        away = [(far, 8.5, 0.0), (-far, 8.5, np.pi), (15.5, far, np.pi / 2), (far, far, np.pi / 4)]
        assert (caster.cast(away, [0.0]) == limit).all(), far
        towards = caster.cast([(far, 8.5, np.pi), (-far, 8.5, 0.0)], [0.0])[:, 0]
        wanted = np.minimum([far - 26, far + 25], limit)
        rounded = limit / 65535 if isinstance(kind, Lookup) else 0
        assert (np.abs(towards - wanted) <= 2 + far * 2.0**-22 + rounded).all(), (far, towards)


def kernel_cast(scene: Scene, kind: Caster, backend: str, precision: str) -> np.ndarray:
    """Ranges in cells of rays that are given to the last bit."""
    device, real = get_backend(backend), np.dtype(precision)
    rows, cols = scene.occupied.shape
    flags = {kind.flag} - {""} | ({"FLOAT64"} if precision == "float64" else set())
    flags |= {"OUTSIDE_OCCUPIED"} if scene.outside_occupied else set()
    flags |= {"ORIGINS_OUTSIDE"} if not ((scene.cell >= 0) & (scene.cell < (cols, rows))).all() else set()
    table = kind.prepare(device, Window(scene.occupied, scene.limit, "occupied" if scene.outside_occupied else "free"))
    pose, count = np.concatenate([scene.frac, scene.direction], axis=1), len(scene.cell)
    result = device.empty(count, real)
    device.compile("cast_ranges", frozenset(flags))(
        (1, count), table.buffer, device.upload(scene.cell.astype(np.int32)), device.upload(pose.astype(real)),
        device.upload(np.array([[1.0, 0.0]], real)), result, rows, cols, count, 1, *kind.scalars(), scene.limit, 1.0,
        scene.limit,
    )  # fmt: skip
    return device.download(result, np.empty(count, real))


@pytest.mark.parametrize("family", FAMILIES)
def test_dda_is_the_exact_caster_to_the_bit(family, backend):
    """Rays through corners, on edges and along axes, walls that touch at corners, tiny maps, walls at the limit."""
    for scene in scenes_of(family)[:4]:
        for precision in ("float32", "float64"):
            same_bits(*(kernel_cast(scene, kind, backend, precision) for kind in (Dda(), Exact())))


# ---------------------------------------------------------------------------------------------------------- march

LEAST_PART = 2.0**-22


def scattered(seed: int, density: float = 0.03) -> tuple[gs.OccupancyGrid, np.ndarray]:
    """Single obstacles, all corners, in cells of 1 m, and 60 poses in free cells."""
    rng = np.random.default_rng(seed)
    cells = np.where(rng.random((50, 60)) < density, 100, 0)
    grid = gs.OccupancyGrid(cells, 1.0)
    xy = rng.uniform((0, 0), (60, 50), (400, 2))
    xy = xy[cells[xy[:, 1].astype(int), xy[:, 0].astype(int)] == 0][:60]
    return grid, np.column_stack([xy, rng.uniform(-np.pi, np.pi, 60)])


def passages(occupied: np.ndarray, x: float, y: float, angle: float, limit: float) -> np.ndarray:
    """(M, 2) where a ray enters obstacles and leaves them again, by cutting it at all lines of the lattice."""
    dx, dy = math.cos(angle), math.sin(angle)
    cuts = [(np.arange(-90, 150) - start) / speed for start, speed in ((x, dx), (y, dy))]
    t = np.unique(np.clip(np.concatenate([*cuts, [0, limit]]), 0, limit))
    middle = (t[1:] + t[:-1]) / 2
    col, row = np.floor(x + middle * dx).astype(int), np.floor(y + middle * dy).astype(int)
    inside = (col >= 0) & (row >= 0) & (col < occupied.shape[1]) & (row < occupied.shape[0])
    hit = np.zeros(len(middle) + 2, int)
    hit[1:-1] = inside & occupied[np.where(inside, row, 0), np.where(inside, col, 0)]
    edges = np.diff(hit)
    return np.column_stack([t[edges == 1], t[edges == -1]])


@pytest.mark.parametrize("tolerance", [1.0, 0.1, 0.01])
def test_marching_is_too_long_by_the_tolerance_or_clips_less_of_a_corner(tolerance, backend):
    """Each ray: what it passed is shorter than the least step there; what it found begins less than that before."""
    bearings, limit, clipped = np.linspace(0, 6, 7), 40.0, 0
    grid, poses = scattered(2)
    rays = [passages(grid.occupied, x, y, theta + b, limit) for x, y, theta in poses for b in bearings]
    for precision, rounding in (("float64", 1e-9), ("float32", 1e-3)):
        caster = gs.RayCaster(grid, limit, method=March(tolerance), backend=backend, precision=precision)
        for ranges, found in zip(rays, caster.cast(poses, bearings).ravel().astype(float), strict=True):
            least = tolerance + LEAST_PART * limit + rounding
            passed = ranges[ranges[:, 0] + least < found]
            assert (passed[:, 1] - passed[:, 0] <= least).all(), (ranges, found)
            clipped += len(passed) > 0
            if found < limit:
                assert ((ranges[:, 0] - rounding <= found) & (found <= ranges[:, 0] + least)).any(), (ranges, found)
    # So many rays of this map pass that near to a corner.
    assert clipped <= 0.3 * tolerance * 2 * len(rays) + 2


def room(seed: int) -> tuple[gs.OccupancyGrid, np.ndarray]:
    """Four walls and nothing else: no corner that a ray could clip."""
    cells = np.full((30, 40), 100)
    cells[2:-2, 2:-2] = 0
    rng = np.random.default_rng(seed)
    return gs.OccupancyGrid(cells, 1.0), rng.uniform((2, 2, -4), (38, 28, 4), (200, 3))


class Counting:
    """A table that counts how often it is looked up."""

    def __init__(self, table: np.ndarray) -> None:
        self.table, self.count = table, 0

    def __getitem__(self, index: np.ndarray) -> np.ndarray:
        self.count += len(index)
        return self.table[index]


def steps(grid: gs.OccupancyGrid, poses: np.ndarray, kind: March, limit: float) -> int:
    """Look-ups of the reference, a ray along each pose's heading."""
    table = Counting(kind.prepare(get_backend("numpy"), Window(grid.occupied, limit, "free")).buffer)
    cell = np.floor(poses[:, :2])
    pose = np.column_stack([poses[:, :2] - cell, np.cos(poses[:, 2]), np.sin(poses[:, 2])])
    ahead, (_, slack, tolerance) = np.tile([1.0, 0.0], (len(pose), 1)), kind.scalars()
    march_reference.cast_ray(
        frozenset({"FLOAT64"}), table, *grid.shape, cell.astype(int), pose, ahead, limit, 0, slack, tolerance
    )
    return table.count


def test_a_smaller_tolerance_is_more_exact_and_takes_more_steps():
    tolerances, limit = (2.0, 0.5, 0.1, 0.02, 0.004), 40.0
    for seed in range(4):
        for make in (room, scattered):
            grid, poses = make(seed)
            exact = gs.RayCaster(grid, limit, backend="numpy", precision="float64").cast(poses, [0.0])
            medians, worst, counts = [], [], []
            for tolerance in tolerances:
                kind = March(tolerance)
                found = gs.RayCaster(grid, limit, method=kind, backend="numpy", precision="float64").cast(poses, [0.0])
                error = (found - exact)[exact < limit]
                assert error.min() >= -1e-12
                medians.append(np.median(error))
                worst.append(error.max())
                counts.append(steps(grid, poses, kind, limit))
            assert sorted(medians, reverse=True) == medians and medians[-1] < 0.02 * medians[0]
            assert sorted(counts) == counts and counts[-1] > 3 * counts[0]
            if make is room:
                assert sorted(worst, reverse=True) == worst
                assert all(w <= t + LEAST_PART * limit for w, t in zip(worst, tolerances, strict=True))


def test_the_rule_centre_takes_fewer_steps_and_errs_more():
    for seed in range(4):
        grid, poses = scattered(seed)
        exact = gs.RayCaster(grid, 40.0, backend="numpy").cast(poses, [0.0])
        errors, counts = [], []
        for rule in ("safe", "centre"):
            found = gs.RayCaster(grid, 40.0, method=March(0.1, rule), backend="numpy").cast(poses, [0.0])
            errors.append(np.abs(found - exact).mean())
            counts.append(steps(grid, poses, March(0.1, rule), 40.0))
        assert errors[1] > errors[0] and counts[1] < 0.7 * counts[0]


def test_a_march_of_a_million_cells_ends(backend):
    """There the tolerance is less than the least difference of two float32 numbers, and a step must still advance."""
    cells = np.zeros((3, 60), int)
    cells[[0, 2]] = cells[1, -1] = 100
    caster = gs.RayCaster(gs.OccupancyGrid(cells, 1.0), 2e6, method=March(0.001), backend=backend)
    for far in (1e3, 1e5, 1e6):
        found = caster.cast([[-far, 1.5, 0.0]], [0.0])[0, 0] - far
        assert -far * 2.0**-23 <= found - 59 <= 0.001 + 2 * far * LEAST_PART


# ------------------------------------------------------------------------------------------------------ bresenham


@pytest.mark.parametrize(
    ("shape", "range_max", "line"),
    [
        ((5, 5), 4.5, [(0, 0), (1, 1), (2, 1), (3, 2), (4, 2)]),
        ((5, 9), 8.6, [(0, 0), (1, 0), (2, 1), (3, 1), (4, 2), (5, 2), (6, 2), (7, 3), (8, 3)]),
    ],
)
def test_bresenham_by_hand(shape, range_max, line, backend):
    """From the cell (0, 0) to the cell (4, 2) and (8, 3): sqrt(i^2 + j^2) where an obstacle (i, j) is on the line."""
    end = line[-1]
    for row, col in np.ndindex(shape):
        cells = np.zeros(shape, int)
        cells[row, col] = 100
        caster = gs.RayCaster(gs.OccupancyGrid(cells, 1.0), range_max, method="bresenham", backend=backend)
        expected = math.sqrt(col * col + row * row) if (col, row) in line else range_max
        assert caster.cast([[0.5, 0.5, math.atan2(end[1], end[0])]], [0.0])[0, 0] == np.float32(expected)


def test_bresenham_slips_between_walls_that_touch_at_a_corner(backend):
    cells = np.zeros((6, 6), int)
    cells[1, 2] = cells[2, 1] = cells[4, 4] = 100
    grid, pose = gs.OccupancyGrid(cells, 1.0), [[1.5, 1.5, math.pi / 4]]
    found = {
        name: gs.RayCaster(grid, 5.0, method=name, backend=backend).cast(pose, [0.0])[0, 0] for name in casters.CASTERS
    }
    assert found["bresenham"] == np.float32(math.sqrt(18))
    assert found["exact"] == found["dda"] == np.float32(math.sqrt(0.5))


def test_bresenham_is_the_same_in_eight_directions(backend):
    rng = np.random.default_rng(3)
    cells, angles = np.where(rng.random((21, 21)) < 0.05, 100, 0), rng.uniform(-np.pi, np.pi, 200)
    cells[10, 10] = 0
    x, y = np.cos(angles), np.sin(angles)
    turned = [(cells, x, y), (cells.T, y, x)]
    for some, u, v in list(turned):
        turned += [(some[:, ::-1], -u, v), (some[::-1], u, -v), (some[::-1, ::-1], -u, -v)]
    results = []
    for some, u, v in turned:
        caster = gs.RayCaster(
            gs.OccupancyGrid(some, 1.0), 9.7, method="bresenham", backend=backend, precision="float64"
        )
        results.append(caster.cast([[10.5, 10.5, 0.0]], np.arctan2(v, u))[0])
    assert 20 < np.count_nonzero(results[0] < 9.7) < 200
    assert (np.array(results) == results[0]).all()


# ----------------------------------------------------------------------------------------------------------- cddt


def clipped_begin(col: int, row: int, turn: float, line: int) -> float | None:
    """Where a cell begins on a line of its bin's direction, in plain Python; None if it is not on the line.

    It is the point of the cell's outline that is farthest back on the middle of the line, or, where the cell does not
    reach the middle, its corner that is nearest to it.
    """
    cos, sin = math.cos(turn), math.sin(turn)
    corners = [(col, row), (col + 1, row), (col + 1, row + 1), (col, row + 1)]
    points = [(x * cos + y * sin, y * cos - x * sin) for x, y in corners]
    low, high = min(v for _, v in points), max(v for _, v in points)
    if high <= line + 1e-9 or low >= line + 1 - 1e-9:
        return None
    middle = min(max(line + 0.5, low), high)
    found = []
    for (u0, v0), (u1, v1) in zip(points, points[1:] + points[:1], strict=True):
        if min(v0, v1) - 1e-12 <= middle <= max(v0, v1) + 1e-12:
            found += [u0, u1] if abs(v1 - v0) < 1e-9 else [u0 + (u1 - u0) * (middle - v0) / (v1 - v0)]
    return min(found)


def lists_of(table: np.ndarray, bins: int) -> dict[tuple[int, int], list[int]]:
    """What a table holds: for each bin and line where obstacles begin, in 2^-10 cells."""
    lines, first = int(table[0]), 1 + 3 * bins
    found = {}
    for bin in range(bins):
        for i in range(lines):
            begin, end = table[first + bin * lines + i : first + bin * lines + i + 2]
            found[bin, i + int(table[3 + 3 * bin])] = table[begin:end].tolist()
    return {key: value for key, value in found.items() if value}


@pytest.mark.parametrize("bins", [4, 7, 8, 12])
def test_directional_table_by_brute_force(bins):
    rng = np.random.default_rng(bins)
    obstacles = rng.random((7, 9)) < 0.3
    obstacles[2:5, 3:6] = True  # the cell (4, 3) sees no free cell
    expected: dict[tuple[int, int], list[float]] = {}
    for row, col in np.argwhere(obstacles).tolist():
        if obstacles[max(row - 1, 0) : row + 2, max(col - 1, 0) : col + 2].all() and 0 < row < 6 and 0 < col < 8:
            continue
        for bin in range(bins):
            for line in range(-20, 20):
                begin = clipped_begin(col, row, 2 * math.pi * bin / bins, line)
                if begin is not None:
                    expected.setdefault((bin, line), []).append(begin)
    found = lists_of(directional_table(obstacles, bins, pruned=False, outside=False), bins)
    assert found.keys() == expected.keys()
    for key, begins in expected.items():
        assert np.abs(np.array(found[key]) - 1024 * np.sort(begins)).max() <= 0.5 + 1e-6, key
    pruned = lists_of(directional_table(obstacles, bins, pruned=True, outside=False), bins)
    for key, begins in found.items():
        # The first is seen from afar, and nothing is added.
        assert pruned[key][0] == begins[0] and not set(pruned[key]) - set(begins)
    assert sum(map(len, pruned.values())) < sum(map(len, found.values()))


@pytest.mark.parametrize("pruned", [True, False])
def test_directional_ranges_on_the_middle_of_a_line_are_exact(pruned, backend):
    """One obstacle, rays in the directions of the bins: along the axes, at 45 degrees, and between."""
    bins, cells = 24, np.zeros((30, 30), int)
    cells[14, 17] = 100
    grid, checked = gs.OccupancyGrid(cells, 1.0), 0
    for bin in range(bins):
        turn = 2 * math.pi * bin / bins
        along, across = np.meshgrid(np.arange(-12.0, 2.0, 0.7), np.arange(-2.0, 3.0))
        middle = math.floor(14.5 * math.cos(turn) - 17.5 * math.sin(turn)) + 0.5 + across.ravel()
        start = 17.5 * math.cos(turn) + 14.5 * math.sin(turn) + along.ravel()
        x, y = start * math.cos(turn) - middle * math.sin(turn), start * math.sin(turn) + middle * math.cos(turn)
        poses = np.column_stack([x, y, np.full(len(x), turn)])
        exact, found = (
            gs.RayCaster(grid, 20.0, method=kind, backend=backend, precision="float64").cast(poses, [0.0])[:, 0]
            for kind in (Exact(), Cddt(bins, pruned))
        )
        hit = exact < 20
        assert np.abs(found - exact)[hit].max() <= 2.0**-10
        checked += np.count_nonzero(hit)
    assert checked > 300


@functools.cache
def floor() -> tuple[gs.OccupancyGrid, np.ndarray, np.ndarray]:
    """A floor of a building and poses in its free cells; distances from the poses to the nearest obstacle's centre."""
    grid = building(3, (12.0, 10.0), 0.1)
    poses = cloud_uniform(grid, 1500, np.random.default_rng(4))
    row, col = np.nonzero(grid.occupied)
    return grid, poses, cKDTree(grid.cell_centers(row, col)).query(poses[:, :2])[0] / grid.resolution


@pytest.mark.parametrize("bins", [36, 216])
def test_directional_ranges_end_near_an_obstacle_and_pass_none(bins):
    """Both ways: across the ray by range * pi / bins + 1 cell, along it by a cell's diagonal."""
    grid, poses, _ = floor()
    limit, bearings = 6.0 / grid.resolution, np.linspace(0, 6, 5)
    cast = functools.partial(gs.RayCaster, grid, 6.0, backend="auto", precision="float64")
    found = cast(method=Cddt(bins, pruned=False)).cast(poses, bearings) / grid.resolution
    angle = poses[:, 2, None] + bearings
    x, y = (poses[:, i, None] / grid.resolution + found * f(angle) for i, f in ((0, np.cos), (1, np.sin)))
    row, col = np.nonzero(grid.occupied)
    near = cKDTree(np.column_stack([col + 0.5, row + 0.5])).query(np.stack([x, y], axis=-1), 30)[1]
    off = [np.maximum(np.abs(place[..., None] - at[near] - 0.5) - 0.5, 0) for place, at in ((x, col), (y, row))]
    distance = np.hypot(*off).min(axis=-1)
    assert (distance <= 1.01 + found * (math.pi / bins + 2e-5))[found < limit].all()
    # The exact ray in the bin's direction enters a cell of the origin's line; it may begin a diagonal off.
    turned = np.round(angle * bins / (2 * math.pi)) * (2 * math.pi / bins)
    clear = np.abs(angle - turned) < 0.49 * 2 * math.pi / bins
    aligned = np.column_stack([np.repeat(poses[:, :2], 5, axis=0), turned.ravel()])
    exact = cast().cast(aligned, [0.0]).reshape(found.shape) / grid.resolution
    assert (found <= np.minimum(exact + 1.42, limit))[clear & (exact > 1.42)].all()


def test_pruned_ranges_differ_beside_an_obstacle_only(backend):
    """Nothing is left out but what begins beside another obstacle of its line: it is seen from beside that, too."""
    grid, poses, clearance = floor()
    for bins in (36, 216):
        every, pruned = (gs.RayCaster(grid, 6.0, method=Cddt(bins, p), backend=backend) for p in (False, True))
        longer = pruned.cast(poses, np.linspace(0, 6, 5)) - every.cast(poses, np.linspace(0, 6, 5))
        assert (longer >= 0).all() and np.count_nonzero(longer) <= 0.01 * longer.size
        assert (longer[clearance > 1.86] == 0).all()
        assert pruned.table_bytes < every.table_bytes


@pytest.mark.parametrize("make", [Cddt, Lookup])
def test_more_bins_are_more_exact(make):
    """Medians, and the share of rays that are wrong by more than two cells; on average over three buildings."""
    median, wrong = [], []
    for bins in (16, 64, 256):
        off = []
        for seed in range(3):
            grid = building(seed, (10.0, 10.0), 0.2)
            poses = cloud_uniform(grid, 1000, np.random.default_rng(seed))
            exact, found = (
                gs.RayCaster(grid, 6.0, method=kind, backend="auto").cast(poses, [0.0, 2.0])
                for kind in (Exact(), make(bins))
            )
            off.append(np.abs(found - exact) / grid.resolution)
        median.append(np.mean([np.median(some) for some in off]))
        wrong.append(np.mean([(some > 2).mean() for some in off]))
    assert median[0] > median[1] > median[2] and wrong[0] > wrong[1] > wrong[2]


# --------------------------------------------------------------------------------------------------------- lookup


def saved(path: Path, backend: str = "numpy", bins: int = 12, **options: object) -> np.ndarray:
    """Write a table of the small map; its numbers, (rows, cols, bins)."""
    grid, _, _ = place()
    gs.RayCaster(grid, RANGE, method=Lookup(bins), backend=backend, **options).save_table(path)
    head, _, body = path.read_bytes().partition(b"\n")
    assert json.loads(head)["bins"] == bins
    return np.frombuffer(body, "<u2").reshape(*grid.shape, bins)


def test_a_look_up_table_holds_the_exact_ranges_of_centres(backend, tmp_path, monkeypatch):
    grid, bins = place()[0], 12
    table = saved(tmp_path / "table", backend)
    # In the grid's own frame, so that headings are the table's to the bit.
    level = gs.OccupancyGrid(grid.cells, 1.0)
    poses = np.column_stack([level.cell_centers(*np.indices(grid.shape).reshape(2, -1)), np.zeros(grid.cells.size)])
    limit = RANGE / grid.resolution
    exact = gs.RayCaster(level, limit, backend="numpy").cast(poses, 2 * np.pi * np.arange(bins) / bins)
    part = exact.astype(np.float64).reshape(table.shape) / limit * 65535
    assert (table[part == 65535] == 65535).all()
    assert np.abs(table - np.minimum(part, 65534))[part < 65535].max() <= 0.5 + 0.02
    # Three rows at a time, and one in the end.
    monkeypatch.setattr(casters, "_TILE", {"cpu": 2100, "gpu": 2100})
    np.testing.assert_array_equal(saved(tmp_path / "tiles", backend), table)


def test_a_saved_table_is_the_same_caster_on_another_backend(backend, tmp_path):
    grid, poses, bearings = place()
    made = gs.RayCaster(grid, RANGE, method=Lookup(12), backend="numpy", outside="occupied")
    made.save_table(str(tmp_path / "table"))
    read = gs.RayCaster(grid, RANGE, method=Lookup(12, file=tmp_path / "table"), backend=backend, outside="occupied")
    same_bits(read.cast(poses, bearings), made.cast(poses, bearings))
    read.save_table(tmp_path / "again")
    assert (tmp_path / "again").read_bytes() == (tmp_path / "table").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["again", "table"]


def test_bins_of_any_integer_type_are_saved(tmp_path):
    assert saved(tmp_path / "table", bins=np.int64(8)).shape[2] == 8


def test_a_table_of_something_else_is_refused(tmp_path):
    grid, poses, bearings = place()
    path, other = tmp_path / "table", gs.OccupancyGrid(np.roll(grid.cells, 1), 0.1, grid.origin)
    saved(path)

    def read(scene=grid, range_max=RANGE, bins=12, **options):
        method = Lookup(bins, file=path)
        gs.RayCaster(scene, range_max, method=method, backend="numpy", **options).cast(poses[:3], bearings)

    read()
    for same, change in (
        ("obstacles", dict(scene=other)),
        ("obstacles", dict(unknown="occupied")),
        ("rows", dict(scene=gs.OccupancyGrid(grid.cells[1:], 0.1))),
        ("limit", dict(range_max=2.5)),
        ("outside", dict(outside="occupied")),
        ("bins", dict(bins=13)),
    ):
        with pytest.raises(ValueError, match=f"^file: must be a table of the same {same}, .*, got .* in .*table$"):
            read(**change)
    whole = path.read_bytes()
    head, _, body = whole.partition(b"\n")
    for damage, words in (
        (whole[:-1], "hold 53760 bytes of ranges, got 53759"),
        (whole + b"\0", "hold 53760 bytes of ranges, got 53761"),
        (head.replace(b'"rows": 40', b'"rows": 4000000000000') + b"\n" + body, "same rows, 40, got 4000000000000"),
        (head.replace(b"lookup 1", b"lookup 2") + b"\n" + body, "a look-up table that gpusense wrote"),
        (b"", "a look-up table that gpusense wrote"),
        (bytes(range(256)) * 300, "a look-up table that gpusense wrote"),
        (b"7\n" + body, "a look-up table that gpusense wrote"),
    ):
        path.write_bytes(damage)
        with pytest.raises(ValueError, match=f"^file: must .*{words}.*table$"):
            read()
    path.unlink()
    with pytest.raises(FileNotFoundError, match="table"):
        read()


@pytest.mark.parametrize(
    "head",
    [b"[" * 4000, b'{"format": "gpusense lookup 1", "rows": 1e9, "cols": 1000000000, "bins": 12}', b"{" * 70_000],
    ids=["nested", "huge", "long"],
)
def test_a_file_that_claims_much_costs_nothing(head, tmp_path):
    grid = place()[0]
    path = tmp_path / "table"
    path.write_bytes(head + b"\n" + bytes(24))
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=r"^file: must be a .*table"):
            read_lookup(path, grid.obstacles(), 30.0, "free", 12)
        assert tracemalloc.get_traced_memory()[1] < 1e6
    finally:
        tracemalloc.stop()


def test_a_table_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "table"
    path.write_bytes(b"before")
    with pytest.raises(TypeError):
        write_lookup(path, np.zeros(3, np.uint16), {"no JSON": object()})

    def full(*_):
        raise OSError("the disk is full")

    with monkeypatch.context() as patch, pytest.raises(OSError, match="the disk is full"):
        patch.setattr("gpusense._files.os.replace", full)
        saved(path)
    assert path.read_bytes() == b"before" and [one.name for one in tmp_path.iterdir()] == ["table"]
    with pytest.raises(FileNotFoundError, match="nowhere"):
        saved(tmp_path / "nowhere" / "table")


# ------------------------------------------------------------------------------------------- models, memory, words


@pytest.mark.parametrize("kind", [Exact(), Dda(), Bresenham(), March(), Cddt(36), Lookup(24)], ids=by_name)
def test_beam_model_is_the_mixture_at_the_casters_ranges(kind, backend):
    grid, poses, bearings = place()
    z = np.random.default_rng(5).uniform(0, RANGE, len(bearings))
    z[1], z[2] = np.nan, np.inf
    p = gs.BeamParameters(0.6, 0.2, 0.1, 0.1, 0.15, 0.7)
    for precision in ("float32", "float64") if backend == "numpy" else ("float32",):
        options = dict(backend=backend, precision=precision)
        model = gs.BeamModel(grid, gs.Scanner(bearings, RANGE), p, caster=kind, **options)
        ranges = gs.RayCaster(grid, RANGE, method=kind, **options).cast(poses[:100], bearings)
        same_bits(model.expected_ranges(poses[:100]), ranges)
        log_p, parts = model.log_likelihood(poses[:100], z, per_beam=True)
        read = z.astype(precision).astype(float)
        expected = log_mixture(read, ranges.astype(float), range_max=RANGE, **p.to_dict())
        expected[:, 1], expected[:, 2] = 0, math.log(p.z_max)
        eps = np.finfo(precision).eps
        assert (np.abs(parts - expected) <= 16 * eps * (1 + np.abs(expected))).all()
        np.testing.assert_allclose(log_p, expected.sum(axis=1), rtol=32 * eps, atol=32 * eps * len(z))


def test_table_bytes_are_those_of_the_documentation(backend):
    grid, poses, bearings = place()
    rows, cols = grid.shape
    table = directional_table(grid.obstacles(), 36, pruned=True, outside=False)
    begins, lines = sum(map(len, lists_of(table, 36).values())), int(table[0])
    documented = {
        Exact(): 4 * (rows + 2) * (cols + 2),
        Dda(): (rows + 2) * (cols + 2),
        Bresenham(): (rows + 2) * (cols + 2),
        March(): 4 * rows * cols,
        Cddt(36, pruned=True): 4 * (2 + 36 * (3 + lines) + rows * cols // 32 + begins),
        Lookup(12): 2 * 12 * rows * cols,
    }
    assert {kind.name for kind in documented} == set(casters.CASTERS)
    for kind, size in documented.items():
        caster = gs.RayCaster(grid, RANGE, method=kind, backend=backend)
        assert caster.table_bytes == 0
        caster.cast(poses[:2], bearings)
        assert caster.table_bytes == size, kind


@pytest.mark.parametrize("name", ["opencl", "warp"])
def test_a_table_too_large_for_the_device_is_an_error_that_names_sizes(name, needs, monkeypatch):
    grid, poses, bearings = place()
    device, case = get_backend(needs(name)), dict(precision="float32", unknown="free", outside="free")
    with monkeypatch.context() as patch:
        patch.setattr(device, "info", dataclasses.replace(device.info, max_buffer=100_000))
        caster = gs.RayCaster(grid, RANGE, method=Lookup(108), backend=device)
        model = gs.BeamModel(grid, gs.Scanner(bearings, RANGE), caster=Lookup(108), backend=device)
        for call in (lambda: caster.cast(poses, bearings), lambda: model.log_likelihood(poses, bearings)):
            with pytest.raises(MemoryError, match="cannot hold a buffer of 483840 bytes: its largest is 100000"):
                call()
        small = gs.RayCaster(grid, RANGE, method=Cddt(8), backend=device).cast(poses, bearings)
    same_bits(small, cast(Cddt(8), "numpy", **case))
    # Both recover once there is room.
    same_bits(caster.cast(poses, bearings), cast(Lookup(108), "numpy", **case))
    assert np.isfinite(model.log_likelihood(poses, bearings)).all()


def test_methods_tell_what_there_is():
    methods = {method.name: method for method in gs.RayCaster.methods()}
    assert list(methods) == ["exact", "dda", "march", "bresenham", "cddt", "lookup"] == list(casters.CASTERS)
    for name, method in methods.items():
        assert all(dataclasses.astuple(method)) and method.backends == ("numpy", "opencl", "warp")
        assert method.error.startswith("exact") == casters.CASTERS[name].exact
        assert gs.RayCaster(place()[0], RANGE, method=name, backend="numpy").method == casters.CASTERS[name]()


def test_the_page_of_casters_mentions_every_method_and_knob():
    page = DOCS.read_text(encoding="utf-8")
    rows = {line.split("|")[1].strip(): line for line in page.splitlines() if line.startswith("| `")}
    for name, kind in casters.CASTERS.items():
        assert f'`"{name}"`' in rows, name
        for knob in dataclasses.fields(kind):
            assert f"`{knob.name}`" in rows[f'`"{name}"`'], (name, knob.name)
    assert "sensor_table=" in page and "save_table(" in page
