"""Angles of incidence: normals of walls of known angle, the cell that a ray hits, and casters."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.incidence_world import INCIDENCE, RANGE, RIGHT, place
from support.raycast_scenes import FAMILIES, Scene, scenes_of

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.evaluation.tolerances import TOLERANCES, differing
from gpusense.interface.structs import Caster, Cone, RangeScale, Window
from gpusense.tables.casters import CASTERS
from gpusense.tables.rectangles import Planes, empty_rectangles
from gpusense.world import windows

# ---------------------------------------------------------------------------------------------------------- normals


def wall(angle: float, thick: float, shift: tuple[float, float]) -> gs.OccupancyGrid:
    """Return a straight wall through the middle of 81 x 81 cells; 0 for a half plane."""
    x, y = np.meshgrid(np.arange(81) + 0.5, np.arange(81) + 0.5)
    off = math.cos(angle) * (y - 40.5 - shift[1]) - math.sin(angle) * (x - 40.5 - shift[0])
    return gs.OccupancyGrid(100 * (off <= 0 if thick == 0 else np.abs(off) <= thick / 2), 1.0)


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
    # A wall around the map has one free side, the column's up to the room's corners.
    found = gs.surface_normals(grid, unknown="occupied", outside="occupied")[:, 0]
    np.testing.assert_allclose(found, [(1, 0)] * 30, atol=0.03)
    for bad in (dict(unknown="maybe"), dict(outside="x")):
        with pytest.raises(ValueError, match="must be one of 'free', 'occupied'"):
            gs.surface_normals(grid, **bad)
    with pytest.raises(TypeError, match="grid: must be an OccupancyGrid"):
        gs.surface_normals(cells)


# ------------------------------------------------------------------------------------------- the cell that a ray hits


def hit_cells(scene: Scene, real: np.dtype) -> tuple[np.ndarray, list[tuple[int, int] | None]]:
    """Return ranges and cells of a plain walk from cell to cell whose every operation is rounded to a precision."""
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


@pytest.mark.sampled(0.3)
@pytest.mark.parametrize("family", FAMILIES)
def test_the_cell_is_the_one_where_the_walk_ends(family, backend):
    """Every wall has another normal, which only the right cell has; there are corners, edges and origins in walls."""
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
        flags = {"CONES", "INCIDENCE", "ORIGINS_OUTSIDE"} | ({"FLOAT64"} if real == np.float64 else set())
        flags |= {"OUTSIDE_OCCUPIED"} if scene.outside_occupied else set()
        buffers = [device.empty(count, real) for _ in range(2)]
        pose = np.concatenate([scene.frac, scene.direction], axis=1).astype(real)
        device.compile("cast_echoes", frozenset(flags))(
            (1, count), empty_rectangles(device, scene.occupied, Planes(1)),
            device.upload(table),
            device.upload(scene.cell.astype(np.int32)), device.upload(pose), device.upload(np.array([1, 0], real)),
            *buffers, Window(0, 0, rows, cols), count, 1, Cone(1, 0.0), Caster(0, 0.0, 0.0),
            RangeScale(scene.limit, 1.0, scene.limit),
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


@pytest.mark.long_on("warp")
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
    """At a long wall of 20 degrees, the angle is 90 degrees minus the angle between beam and wall."""
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
    monkeypatch.setattr(windows, "SMALLEST_CELLS", 100)
    caster = gs.RayCaster(grid, 20.0, backend=backend)
    caster.prepare([[200.5, 150.5, 0.0]])
    tolerance = TOLERANCES["float32 angles of incidence"]
    found = caster.incidence(poses, bearings)
    assert caster._caster.map.window.cells < cells.size / 4
    assert caster.table_bytes > 8 * caster._caster.map.window.cells
    np.testing.assert_array_equal(np.isnan(found), np.isnan(whole))
    assert tolerance.difference(np.nan_to_num(found), np.nan_to_num(whole)) <= tolerance.value
    patch = np.full((6, 2), 100)
    caster.update_map(patch, (155, 212))
    anew = gs.RayCaster(caster.grid, 20.0, backend=backend).incidence(poses, bearings)
    assert differing(caster.incidence(poses, bearings), anew) == 0
    assert differing(anew, found) > 20


@pytest.mark.parametrize("method", [name for name, kind in CASTERS.items() if not kind.exact])
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
