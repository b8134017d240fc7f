"""Angles of incidence: normals against walls of known angle, the cell that a ray hits, parameters by angle."""

from __future__ import annotations

import math

import numpy as np
import pytest
from conftest import on_every_backend
from raycast_scenes import FAMILIES, Scene, scenes_of

import gpusense as gs
from gpusense import cloud, region
from gpusense.backends import get_backend
from gpusense.prepare import empty_rectangles
from gpusense.reference.densities import log_mixture
from gpusense.tolerances import TOLERANCES, differing, per_beam, per_scan

RIGHT = math.pi / 2
RANGE = 6.0
P = gs.BeamParameters
EDGES = (0.0, 0.3, 0.8, RIGHT)
KINDS = (P(0.8, 0.1, 0.05, 0.05, 0.05, 0.3), P(0.6, 0.2, 0.1, 0.1, 0.15, 0.6), P(0.2, 0.1, 0.5, 0.2, 0.4, 0.1))
INCIDENCE = gs.IncidenceParameters(EDGES, KINDS)


# ---------------------------------------------------------------------------------------------------------- normals


def wall(angle: float, thick: float, shift: tuple[float, float]) -> gs.OccupancyGrid:
    """A straight wall through the middle of 81 x 81 cells; 0 for a half plane."""
    x, y = np.meshgrid(np.arange(81) + 0.5, np.arange(81) + 0.5)
    off = math.cos(angle) * (y - 40.5 - shift[1]) - math.sin(angle) * (x - 40.5 - shift[0])
    return gs.OccupancyGrid(100 * (off <= 0 if thick == 0 else np.abs(off) <= thick / 2), 1.0)


@pytest.mark.parametrize("thick", [1.0, 1.5, 3.0, 5.0, 0.0])
def test_normals_of_straight_walls(thick, record_property):
    rng = np.random.default_rng(4)
    errors = []
    for angle in (0.0, 0.02, RIGHT / 2, *rng.uniform(0, math.pi, 40)):
        # A line's width in cells along an axis is at least one, so that it has no holes.
        least = max(abs(math.cos(angle)), abs(math.sin(angle)))
        normals = gs.surface_normals(wall(angle, thick * least, rng.uniform(-1, 1, 2)))[10:-10, 10:-10]
        found = normals[~np.isnan(normals[..., 0])]
        np.testing.assert_allclose(np.hypot(*found.T), 1, rtol=1e-12)
        along = found @ (-math.sin(angle), math.cos(angle))
        errors.append(np.degrees(np.arccos(np.minimum(np.abs(along), 1))))
        if thick == 0:
            assert (along > 0.9).all()
    each = np.concatenate(errors)
    record_property("mean error in degrees", float(each.mean()))
    record_property("largest error in degrees", float(each.max()))
    assert each.mean() <= TOLERANCES["normals of straight walls, mean"].value
    assert each.max() <= TOLERANCES["normals of straight walls, largest"].value


@pytest.mark.parametrize("radius", [5, 12, 40])
@pytest.mark.parametrize("filled", [True, False])
def test_normals_of_circles(radius, filled):
    """A disc's point outwards; a thin ring's lie along the radius, whichever way."""
    side = 2 * radius + 11
    x, y = np.meshgrid(*2 * [np.arange(side) + 0.5 - side / 2])
    far = np.hypot(x, y)
    normals = gs.surface_normals(gs.OccupancyGrid(100 * (far <= radius if filled else abs(far - radius) <= 0.6), 1.0))
    known = ~np.isnan(normals[..., 0])
    outwards = (normals * np.stack([x, y], axis=-1)).sum(axis=-1)[known] / far[known]
    error = np.degrees(np.arccos(np.minimum(outwards if filled else abs(outwards), 1)))
    assert known.sum() >= 5 * radius
    # A window of 9 cells sees a bend of 4.5 / radius.
    assert error.mean() <= 2.5 and error.max() <= 9


def test_cells_without_a_surface_have_no_normal():
    cells = np.zeros((60, 60), int)
    cells[5, 5] = cells[5, 40] = cells[5, 41] = 100
    cells[20:40, 20:40] = 100
    normals = gs.surface_normals(gs.OccupancyGrid(cells, 0.1))
    assert np.isnan(normals[[5, 5, 5], [5, 40, 41]]).all()
    assert np.isnan(normals[21:39, 21:39]).all() and np.isnan(normals[cells == 0]).all()
    middle = [(20, 30), (39, 30), (30, 20), (30, 39)]
    np.testing.assert_allclose([normals[at] for at in middle], [(0, -1), (0, 1), (-1, 0), (1, 0)], atol=1e-12)
    half = math.sqrt(0.5)
    np.testing.assert_allclose(normals[[20, 39], [20, 39]], [(-half, -half), (half, half)], atol=1e-12)


def test_normals_turn_with_the_map_and_know_its_surroundings():
    cells = np.zeros((30, 40), int)
    cells[10, 3:30] = 100
    plain = gs.surface_normals(gs.OccupancyGrid(cells, 0.1))
    turned = gs.surface_normals(gs.OccupancyGrid(cells, 0.1, (5.0, -3.0, 0.7)))
    c, s = math.cos(0.7), math.sin(0.7)
    np.testing.assert_allclose(turned, plain @ np.array([[c, s], [-s, c]]), atol=1e-12)
    cells[:] = 0
    cells[:, 0] = -1
    grid = gs.OccupancyGrid(cells, 0.1)
    assert np.isnan(gs.surface_normals(grid)).all()
    thin = gs.surface_normals(grid, unknown="occupied")[10:20, 0]
    np.testing.assert_allclose(np.abs(thin), [(1, 0)] * 10, atol=1e-12)
    # Beside a wall around the map, its cells are at rest in a corner.
    found = gs.surface_normals(grid, unknown="occupied", outside="occupied")
    assert found[0, 0, 0] > 0.5 and found[0, 0, 1] > 0.5
    for bad in (dict(unknown="maybe"), dict(outside="x")):
        with pytest.raises(ValueError, match="must be one of 'free', 'occupied'"):
            gs.surface_normals(grid, **bad)
    with pytest.raises(TypeError, match="grid: must be an OccupancyGrid"):
        gs.surface_normals(cells)


def test_normals_do_not_depend_on_how_a_map_is_cut():
    from gpusense import normals

    rng = np.random.default_rng(3)
    obstacles = rng.random((70, 90)) < 0.2
    for outside in ("free", "occupied"):
        everything = normals.normal_table(obstacles, region.Region(0, 0, 70, 90), outside, np.dtype(float))
        for part in (region.Region(0, 0, 20, 30), region.Region(33, 41, 37, 49), region.Region(10, 80, 5, 1)):
            cut = normals.normal_table(obstacles, part, outside, np.dtype(float))
            want = everything[part.row : part.row + part.rows + 2, part.col : part.col + part.cols + 2]
            np.testing.assert_array_equal(cut, want)


# ------------------------------------------------------------------------------------------- the cell that a ray hits


def hit_cells(scene: Scene, real: np.dtype) -> tuple[np.ndarray, list[tuple[int, int] | None]]:
    """Ranges and cells of a plain walk from cell to cell whose every operation is rounded to a precision."""
    one, limit = real.type(1), real.type(scene.limit)
    rows, cols = scene.occupied.shape
    ranges, cells = np.full(len(scene.cell), limit, real), []
    for i, ((x, y), frac, d) in enumerate(
        zip(scene.cell.tolist(), scene.frac.astype(real), scene.direction.astype(real), strict=True)
    ):
        dx, dy = (real.type(0) if abs(v) < 1e-30 else v for v in d)
        step_x, step_y = (1 if dx >= 0 else -1), (1 if dy >= 0 else -1)
        inv_x, inv_y = (one / abs(v) if v else None for v in (dx, dy))
        a_x, a_y = one - frac[0] if dx >= 0 else frac[0], one - frac[1] if dy >= 0 else frac[1]
        k_x = k_y = 0
        t = real.type(0)
        cells.append(None)
        while t < limit:
            col, row = x + step_x * k_x, y + step_y * k_y
            inside = 0 <= col < cols and 0 <= row < rows
            if scene.occupied[row, col] if inside else scene.outside_occupied:
                ranges[i], cells[i] = t, (col, row)
                break
            t_x = (real.type(k_x) + a_x) * inv_x if inv_x is not None else np.inf
            t_y = (real.type(k_y) + a_y) * inv_y if inv_y is not None else np.inf
            t = min(t_x, t_y)
            k_x, k_y = (k_x + 1, k_y) if t_x <= t_y else (k_x, k_y + 1)
    return ranges, cells


@pytest.mark.parametrize("family", FAMILIES)
def test_the_cell_is_the_one_where_the_walk_ends(family, backend):
    """Every wall has another normal, which nothing but the right cell gives; corners, edges and origins in walls."""
    rng, device = np.random.default_rng(8), get_backend(backend)
    hits = 0
    for number, full in enumerate(scenes_of(family)[:4]):
        some = slice(0, 400)
        scene = Scene(full.occupied, full.cell[some], full.frac[some], full.direction[some], full.limit,
                      full.outside_occupied)  # fmt: skip
        real = np.dtype(np.float32 if number < 3 or backend.startswith("warp") else np.float64)
        with np.errstate(over="ignore"):
            ranges, cells = hit_cells(scene, real)
        (rows, cols), count = scene.occupied.shape, len(scene.cell)
        angles = rng.uniform(0, math.pi, (rows + 2, cols + 2))
        walls = np.pad(scene.occupied, 1, constant_values=scene.outside_occupied)
        table = np.where(walls[..., None], np.stack([np.cos(angles), np.sin(angles)], axis=-1), 0).astype(real)
        flags = {"ECHO", "INCIDENCE", "ORIGINS_OUTSIDE"} | ({"FLOAT64"} if real == np.float64 else set())
        flags |= {"OUTSIDE_OCCUPIED"} if scene.outside_occupied else set()
        buffers = [device.empty(count, real) for _ in range(2)]
        pose = np.concatenate([scene.frac, scene.direction], axis=1).astype(real)
        device.compile("cast_echoes", frozenset(flags))(
            (1, count), empty_rectangles(device, scene.occupied, 1), device.upload(table),
            device.upload(scene.cell.astype(np.int32)), device.upload(pose), device.upload(np.array([1, 0], real)),
            *buffers, rows, cols, count, 1, 1, 0.0, 0, 0.0, 0.0, scene.limit, 1.0, scene.limit,
        )  # fmt: skip
        found, incidence = (device.download(buffer, np.empty(count, real)) for buffer in buffers)
        assert differing(found, ranges) == 0
        expected = np.full(count, np.nan)
        for i, cell in enumerate(cells):
            if cell is None:
                continue
            expected[i] = 0.0
            if -1 <= cell[0] <= cols and -1 <= cell[1] <= rows:
                d, n = (
                    np.where(np.abs(pose[i, 2:]) < 1e-30, 0, pose[i, 2:]).astype(float),
                    table[cell[1] + 1, cell[0] + 1],
                )
                expected[i] = math.atan2(abs(d[0] * n[1] - d[1] * n[0]), abs(d @ n.astype(float)))
            hits += 1
        np.testing.assert_array_equal(np.isnan(incidence), np.isnan(expected))
        np.testing.assert_allclose(incidence, expected, atol=8 * np.finfo(real).eps)
    assert hits > 50


# ----------------------------------------------------------------------------------------------------------- casters


def place() -> tuple[gs.OccupancyGrid, np.ndarray, np.ndarray]:
    """A slanted wall, a round post, a thick block and dots; poses all over, some in walls or off the map; bearings."""
    rng = np.random.default_rng(6)
    cells = np.zeros((90, 120), int)
    x, y = np.meshgrid(np.arange(120) + 0.5, np.arange(90) + 0.5)
    cells[np.abs(0.4 * x - y + 10) < 0.8] = cells[np.hypot(x - 80, y - 25) < 6] = 100
    cells[60:75, 20:45] = cells[:2] = cells[:, 118] = 100
    cells[rng.random(cells.shape) < 0.002] = 100
    cells[rng.random(cells.shape) < 0.01] = -1
    grid = gs.OccupancyGrid(cells, 0.1, (1.0, -2.0, 0.3))
    xy = grid.cell_centers(rng.integers(-8, 98, 150), rng.integers(-8, 128, 150)) + rng.uniform(-0.05, 0.05, (150, 2))
    return grid, np.column_stack([xy, rng.uniform(-4, 4, 150)]), np.linspace(-3, 3, 23)


@pytest.mark.parametrize("outside", ["free", "occupied"])
def test_incidence_is_the_same_everywhere(outside, backend):
    grid, poses, bearings = place()
    for precision in ("float32",) if backend.startswith("warp") else ("float32", "float64"):
        case = dict(unknown="occupied" if outside == "occupied" else "free", outside=outside, precision=precision)
        caster = gs.RayCaster(grid, RANGE, backend=backend, **case)
        found, ranges = caster.incidence(poses, bearings), caster.cast(poses, bearings)
        assert found.shape == (150, 23) and found.dtype == precision
        np.testing.assert_array_equal(np.isnan(found), ranges == caster.range_max)
        known = found[~np.isnan(found)]
        assert (known >= 0).all() and (known <= np.nextafter(found.dtype.type(RIGHT), 9)).all()
        assert np.ptp(known) > 1.4
        truth = gs.RayCaster(grid, RANGE, backend="numpy", **case).incidence(poses, bearings)
        tolerance = TOLERANCES[f"{precision} angles of incidence"]
        np.testing.assert_array_equal(np.isnan(found), np.isnan(truth))
        assert tolerance.difference(np.nan_to_num(found), np.nan_to_num(truth)) <= tolerance.value
        out = np.empty_like(found)
        assert caster.incidence(poses[:40], bearings, out=out[:40]) is not None
        assert differing(out[:40], found[:40]) == 0


def test_incidence_on_a_slanted_wall_is_what_geometry_says(backend):
    """A long wall at 20 degrees, seen from one side: 90 degrees less the angle between beam and wall."""
    slope = math.radians(20)
    x, y = np.meshgrid(np.arange(400) + 0.5, np.arange(400) + 0.5)
    off = math.cos(slope) * (y - 200) - math.sin(slope) * (x - 200)
    grid = gs.OccupancyGrid(100 * (np.abs(off) < 1), 0.05)
    poses = np.column_stack([np.random.default_rng(1).uniform((10.2, 5.7), (12.2, 7.7), (60, 2)), np.zeros(60)])
    bearings = slope + np.linspace(0.6, math.pi - 0.6, 31)
    found = gs.RayCaster(grid, 10.0, backend=backend).incidence(poses, bearings)
    expected = np.abs(bearings - slope - RIGHT)
    error = np.degrees(np.abs(found - expected))
    assert not np.isnan(error).any()
    assert error.mean() <= TOLERANCES["normals of straight walls, mean"].value
    assert error.max() <= TOLERANCES["normals of straight walls, largest"].value
    model = gs.BeamModel(grid, gs.Scanner(bearings, 10.0), backend=backend)
    assert differing(model.incidence(poses), found) == 0


def test_head_on_without_a_normal_and_inside_walls():
    cells = np.zeros((20, 20), int)
    cells[10, 15] = 100
    caster = gs.RayCaster(gs.OccupancyGrid(cells, 1.0), 9.0, backend="numpy")
    np.testing.assert_array_equal(caster.incidence([(9.5, 10.5, 0.0)], [0.0, 0.04, 2.0])[0], [0, 0, np.nan])
    np.testing.assert_array_equal(caster.incidence([(15.5, 10.5, 1.0)], [0.3]), [[0.0]])
    caster = gs.RayCaster(gs.OccupancyGrid(np.full((30, 30), 100), 1.0), 9.0, backend="numpy", outside="occupied")
    np.testing.assert_array_equal(caster.incidence([(15.5, 15.5, 1.0), (-40.0, 3.0, 0.0)], [0.3]), [[0.0], [0.0]])


def test_a_cropped_or_changed_map_has_the_angles_of_a_new_one(backend, monkeypatch):
    rng = np.random.default_rng(1)
    cells = rng.choice([0, 100], (300, 400), p=[0.99, 0.01])
    grid = gs.OccupancyGrid(cells, 1.0)
    poses = np.column_stack([rng.uniform(208, 209.5, 60), rng.uniform(158, 159.5, 60), rng.uniform(-3, 3, 60)])
    bearings = np.linspace(-3, 3, 9)
    whole = gs.RayCaster(grid, 20.0, backend="numpy").incidence(poses, bearings)
    monkeypatch.setattr(region, "SMALLEST_CELLS", 100)
    caster = gs.RayCaster(grid, 20.0, backend=backend)
    caster.prepare([[200.5, 150.5, 0.0]])
    tolerance = TOLERANCES["float32 angles of incidence"]
    found = caster.incidence(poses, bearings)
    assert caster._caster.map.region.cells < cells.size / 4
    assert caster.table_bytes > 8 * caster._caster.map.region.cells
    np.testing.assert_array_equal(np.isnan(found), np.isnan(whole))
    assert tolerance.difference(np.nan_to_num(found), np.nan_to_num(whole)) <= tolerance.value
    patch = np.full((6, 2), 100)
    caster.update_map(patch, (155, 212))
    anew = gs.RayCaster(caster.grid, 20.0, backend=backend).incidence(poses, bearings)
    assert differing(caster.incidence(poses, bearings), anew) == 0
    assert differing(anew, found) > 20


@pytest.mark.parametrize("method", ["march", "bresenham", "cddt", "lookup"])
def test_casters_that_are_not_exact_have_no_angles(method):
    grid, poses, bearings = place()
    with pytest.raises(ValueError, match="method: must be an exact one where angles of incidence matter"):
        gs.RayCaster(grid, RANGE, method=method, backend="numpy").incidence(poses, bearings)
    model = gs.BeamModel(grid, gs.Scanner(bearings, RANGE), caster=method, backend="numpy")
    with pytest.raises(ValueError, match="caster: must be an exact one"):
        model.incidence(poses)
    with pytest.raises(ValueError, match="caster: must be an exact one"):
        gs.BeamModel(grid, gs.Scanner(bearings, RANGE), incidence=INCIDENCE, caster=method, backend="numpy")


def test_the_walk_from_cell_to_cell_has_the_same_angles(backend):
    grid, poses, bearings = place()
    one, other = (gs.RayCaster(grid, RANGE, method=way, backend=backend) for way in ("exact", "dda"))
    assert differing(one.incidence(poses, bearings), other.incidence(poses, bearings)) == 0


# ------------------------------------------------------------------------------------------------------------ models


def a_scan(count: int = 23) -> np.ndarray:
    z = np.random.default_rng(5).uniform(0.1, RANGE, count)
    z[[2, 9]], z[[4, 5, 20]] = np.nan, np.inf
    return z


def model_of(backend, **options) -> gs.BeamModel:
    grid, _, bearings = place()
    bearings = np.append(bearings[:-1], bearings[3])
    scanner = gs.Scanner(bearings, RANGE, mount=(0.2, 0.1, 0.3))
    return gs.BeamModel(grid, scanner, backend=backend, **({"incidence": INCIDENCE} | options))


def brute_force(model: gs.BeamModel, poses: np.ndarray, z: np.ndarray) -> np.ndarray:
    """(N, K) log densities, each with the parameters of its own angle."""
    parameters = model.incidence_parameters
    expected, angle = model.expected_ranges(poses).astype(float), model.incidence(poses).astype(float)
    which = np.searchsorted(parameters.edges[1:-1], np.nan_to_num(angle), side="right")
    # Next to an edge rounding may choose either side.
    assert not np.isclose(np.nan_to_num(angle)[..., None], parameters.edges[1:-1], rtol=0, atol=2e-6).any()
    real = np.dtype(model.precision)
    found = np.zeros(expected.shape)
    if parameters.no_surface is not None:
        which = np.where(np.isnan(angle), len(parameters.parameters), which)
    for i, p in enumerate((*parameters.parameters, parameters.no_surface or P())):
        read = np.broadcast_to(z.astype(real).astype(float), found.shape)
        with np.errstate(all="ignore"):
            each = log_mixture(np.nan_to_num(read, posinf=0.0), expected, range_max=RANGE, **p.to_dict())
            each = np.where(np.isinf(read), np.log(p.z_max), np.where(np.isnan(read), 0.0, each))
        found = np.where(which == i, each, found)
    return found


@pytest.mark.parametrize("no_surface", [None, P(0.05, 0.05, 0.8, 0.1, 0.3, 0.2)])
def test_every_beam_has_the_parameters_of_its_angle(no_surface, backend):
    _, poses, _ = place()
    z = a_scan()
    incidence = gs.IncidenceParameters(EDGES, KINDS, no_surface)
    for precision in ("float32",) if backend.startswith("warp") else ("float32", "float64"):
        model = model_of(backend, precision=precision, temperature=0.5, incidence=incidence)
        assert np.isnan(model.incidence(poses)).any() and (", parameters for 3 ranges" in model.explain())
        truth = brute_force(model, poses, z)
        log_p, parts = model.log_likelihood(poses, z, per_beam=True)
        # The truth's terms are not rounded to the model's precision, nor its readings.
        assert (np.abs(parts - truth) <= 3 * per_beam(truth, precision)).all()
        assert (np.abs(log_p - 0.5 * truth.sum(axis=1)) <= 3 * per_scan(truth, precision)).all()
        assert differing(model.log_likelihood(poses, z), log_p) == 0
        assert (np.ptp(parts[:, 4]) > 1) and (parts[:, [2, 9]] == 0).all()
        assert (" and for none" in model.explain()) == (no_surface is not None)


@on_every_backend(
    on_warp=lambda weights: weights != (1, 0, 0, 0), weights=[(0.7, 0.1, 0.1, 0.1), (1, 0, 0, 0), (0.5, 0.5, 0, 0)]
)
def test_equal_bins_are_the_plain_model(weights, backend):
    _, poses, _ = place()
    parameters = P(*weights)
    same = gs.IncidenceParameters(EDGES, (parameters,) * 3)
    z = a_scan()
    for precision in ("float32", "float64") if backend == "numpy" else ("float32",):
        model = model_of(backend, incidence=same, precision=precision)
        plain = model_of(backend, incidence=None, parameters=parameters, precision=precision)
        found, parts = model.log_likelihood(poses, z, per_beam=True)
        expected, plain_parts = plain.log_likelihood(poses, z, per_beam=True)
        if "WIDE" in plain._last_code:
            # Functions of vectors may round otherwise.
            assert (np.abs(parts - plain_parts) <= 2 * per_beam(plain_parts, precision)).all()
            assert (np.abs(found - expected) <= 2 * per_scan(plain_parts, precision)).all()
        else:
            assert differing(parts, plain_parts) == 0 and differing(found, expected) == 0


def test_tiles_and_orders_change_nothing(as_gpu, backend, monkeypatch):
    _, poses, _ = place()
    model, z = model_of(as_gpu(False)), a_scan()
    one_by_one, parts = model.log_likelihood(poses, z, per_beam=True)
    assert "WIDE" not in model._last_code
    for least in (cloud.LEAST_ORDERED, (1, 1)):
        monkeypatch.setattr(cloud, "LEAST_ORDERED", least)
        tiled = model_of(as_gpu(True))
        assert differing(tiled.log_likelihood(poses, z), one_by_one) == 0
        assert "INCIDENCE" in tiled._last_code
    assert differing(tiled.log_likelihood(poses, z, per_beam=True)[1], parts) == 0
    as_gpu(False)
    assert differing(model.log_likelihood(poses[7:9], z), one_by_one[7:9]) == 0


def test_max_readings_where_their_probability_depends_on_the_pose(backend):
    _, poses, bearings = place()
    some = (P(0.9, 0.05, 0.0, 0.05), P(0.5, 0.2, 0.2, 0.1), P(0.0, 0.0, 1.0, 0.0))
    model = model_of(backend, incidence=gs.IncidenceParameters(EDGES, some))
    z = np.full(len(bearings), np.inf)
    log_p, parts = model.log_likelihood(poses, z, per_beam=True)
    which = np.searchsorted(EDGES[1:-1], np.nan_to_num(model.incidence(poses)), side="right")
    expected = np.array([-np.inf, math.log(0.2), 0.0])[which]
    np.testing.assert_allclose(parts, expected, rtol=1e-6)
    np.testing.assert_allclose(log_p, expected.sum(axis=1), rtol=1e-5)
    # A bin whose continuous part is 0 makes a range impossible, and only there.
    z = np.full(len(bearings), 3.0)
    parts = model.log_likelihood(poses, z, per_beam=True)[1]
    np.testing.assert_array_equal(np.isneginf(parts), which == 2)
    never = model_of(backend, incidence=gs.IncidenceParameters((0, 1, RIGHT), (P(0, 0, 1, 0), P(0, 0, 1, 0))))
    assert np.isneginf(never.log_likelihood(poses, z)).all()


def test_what_is_left_out_changes_nothing(backend):
    _, poses, _ = place()
    z = a_scan()
    lean, whole = model_of(backend), model_of(backend, specialize=False)
    expected, parts = lean.log_likelihood(poses, z, per_beam=True)
    found, each = whole.log_likelihood(poses, z, per_beam=True)
    assert (np.abs(each - parts) <= 2 * per_beam(parts, "float32")).all()
    assert (np.abs(found - expected) <= 2 * per_scan(parts, "float32")).all()
    text = lean.explain()
    assert "parameters for 3 ranges of the angle of incidence (max readings depend on it)" in text.splitlines()[0]
    assert "INCIDENCE" in text and "probability z_max at every pose" not in text
    same = gs.IncidenceParameters((0, 0.5, RIGHT), (P(sigma_hit=0.1), P(sigma_hit=0.3)))
    equal = model_of(backend, incidence=same)
    equal.log_likelihood(poses, z)
    assert "depend on it" not in equal.explain() and "probability z_max at every pose" in equal.explain()


def test_a_changed_map_changes_the_model():
    _, poses, _ = place()
    model, z = model_of("numpy"), a_scan()
    model.log_likelihood(poses, z)
    model.update_map(np.full((4, 30), 100), (40, 50))
    anew = gs.BeamModel(model.grid, model.scanner, incidence=INCIDENCE, backend="numpy")
    assert differing(model.log_likelihood(poses, z), anew.log_likelihood(poses, z)) == 0


def test_arguments_that_do_not_go_together():
    grid, _, bearings = place()
    scene = (grid, gs.Scanner(bearings, RANGE))
    for name, options in (
        ("parameters", dict(parameters=P())),
        ("sensor_table", dict(sensor_table=0.1)),
        ("compat", dict(compat="amcl")),
    ):
        with pytest.raises(ValueError, match=f"{name}: must be None with incidence, got"):
            gs.BeamModel(*scene, incidence=INCIDENCE, backend="numpy", **options)
    with pytest.raises(TypeError, match="incidence: must be IncidenceParameters, got"):
        gs.BeamModel(*scene, incidence=[P()], backend="numpy")
    model = gs.BeamModel(*scene, incidence=INCIDENCE, backend="numpy")
    assert model.incidence_parameters is INCIDENCE
    with pytest.raises(AttributeError, match="see incidence_parameters"):
        _ = model.parameters
    plain = gs.BeamModel(*scene, backend="numpy")
    assert plain.incidence_parameters is None and plain.parameters == P()
