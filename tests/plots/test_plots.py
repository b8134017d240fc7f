"""Pictures: positions, colours, and atomic files."""

from __future__ import annotations

import math

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from support.feature_scenes import floor_plan

import gpusense as gs
from gpusense import plots
from gpusense.evaluation import worlds
from gpusense.plots import drawing, pose_densities
from gpusense.plots.features import features_figure, landmarks_figure


def test_all_kinds_are_drawn_with_one_label_each():
    scanner = gs.Scanner(np.linspace(-math.pi, math.pi, 720, endpoint=False), range_max=20.0)
    floor = floor_plan(4)
    scans, _ = floor.cast(floor.poses(12, 4), scanner.bearings)
    features = gs.extract_features(scans, scanner, backend="numpy")
    k = int(np.argmax([len(set(features.of_scan(k).kind)) for k in range(12)]))
    one = features.of_scan(k)
    figure = features_figure(one, scans[k], scanner)
    _, labels = figure.axes[0].get_legend_handles_labels()
    assert sorted(labels) == sorted({"readings", *one.kind.tolist()})
    assert len(figure.axes[0].patches) >= (one.kind == "pole").sum()
    with pytest.raises(ValueError, match="ranges: shape"):
        gs.plots.draw_features(gs.plots.new_figure(4, 4).subplots(), one, scans[k, :5], scanner)


def test_landmarks_are_drawn_where_they_are():
    cells = np.zeros((80, 120), np.int8)
    cells[[0, -1]] = cells[:, [0, -1]] = 100
    grid = gs.OccupancyGrid(cells, resolution=0.05)
    landmarks = gs.landmarks_of_map(grid, backend="numpy")
    (ax,) = landmarks_figure(landmarks, grid).axes
    (dots,) = [line for line in ax.lines if line.get_label() == "corner"]
    np.testing.assert_allclose(np.column_stack(dots.get_data()), landmarks.landmarks("corner").xy)
    drawn = [np.column_stack(line.get_data()).ravel() for line in ax.lines if len(line.get_xdata()) == 2]
    for wall in landmarks.lines().segments:
        assert any(np.array_equal(wall, one) for one in drawn)


TURNED = (5e5, -3e5, 0.6)


def lone_cell(origin: tuple[float, float, float]) -> gs.OccupancyGrid:
    """Return a grid of 20 x 30 cells of 0.1 m: one block occupied, one unknown, the rest free."""
    cells = np.zeros((20, 30), np.int8)
    cells[3:7, 20:25] = 100
    cells[12:17, 4:9] = -1
    return gs.OccupancyGrid(cells, 0.1, origin)


def colour_at(figure, ax, x: float, y: float) -> tuple[float, ...]:
    """Return the colour of the rendered pixel at a point of the axes' data, 0 to 1."""
    figure.canvas.draw()
    pixels = np.asarray(figure.canvas.buffer_rgba())
    across, up = ax.transData.transform((x, y))
    return tuple(pixels[pixels.shape[0] - 1 - int(up), int(across), :3] / 255)


def new_axes():
    figure = plots.new_figure(6.0, 5.0)
    return figure, figure.subplots()


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), TURNED, (0.0, 0.0, -2.5)], ids=["plain", "far", "reversed"])
def test_map_is_drawn_where_its_cells_are(origin):
    grid = lone_cell(origin)
    figure, ax = new_axes()
    plots.draw_map(ax, grid)
    wanted = {(5, 22): drawing.OCCUPIED, (14, 6): drawing.UNKNOWN, (10, 15): drawing.FREE, (14, 22): drawing.FREE}
    for (row, col), colour in wanted.items():
        x, y = grid.cell_centers([row], [col])[0]
        assert colour_at(figure, ax, x, y) == pytest.approx(to_rgb(colour), abs=0.01), (row, col)
    x_min, y_min, x_max, y_max = grid.bounds()
    assert (ax.get_xlim(), ax.get_ylim()) == ((x_min, x_max), (y_min, y_max))
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x [m]", "y [m]")


def test_scan_ends_where_its_readings_say():
    grid = lone_cell(TURNED)
    scanner = gs.Scanner([-0.5, 0.0, 0.5, 1.0, 1.5], 5.0, range_min=0.1, mount=(0.3, 0.1, 0.2))
    pose = np.array([5e5 + 1, -3e5 + 1, 0.4])
    ranges = [1.0, math.inf, 2.0, 0.05, math.nan]
    _, ax = new_axes()
    assert plots.draw_scan(ax, grid, scanner, pose, ranges) == 2
    c, s = math.cos(0.4), math.sin(0.4)
    start = np.array([pose[0] + c * 0.3 - s * 0.1, pose[1] + s * 0.3 + c * 0.1])
    heading = np.array([0.4 + 0.2 - 0.5, 0.4 + 0.2 + 0.5])
    ends = start + np.array([[1.0], [2.0]]) * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    beams, points = ax.collections
    assert np.asarray(points.get_offsets()) == pytest.approx(ends, abs=1e-6)
    assert np.array(beams.get_segments()) == pytest.approx(np.stack([[start, start], ends], axis=1), abs=1e-6)


def test_particles_are_coloured_by_likelihood_with_the_best_on_top():
    poses = np.array([[1.0, 0, 0], [2, 0, 0], [3, 0, 0], [4, 0, 0]])
    _, ax = new_axes()
    cloud = plots.draw_particles(ax, poses, [-1.0, -100.0, -np.inf, -5.0])
    assert np.asarray(cloud.get_offsets())[:, 0].tolist() == [3, 2, 4, 1]
    # The scale ends at the median, with half of the finite values.
    assert cloud.get_clim() == (-5.0, -1.0)
    assert np.isfinite(cloud.get_array()).all()
    assert plots.draw_particles(ax, poses, [-1.0, -100.0, -np.inf, -5.0], depth=50).get_clim() == (-51.0, -1.0)


@pytest.mark.parametrize("spacing", [0.1, 0.3, 0.7, 100.0])
def test_lattice_stands_on_free_cells(spacing):
    grid = worlds.building(1, (16.0, 12.0), 0.1)
    grid = gs.OccupancyGrid(grid.cells, 0.1, TURNED)
    poses, free, extent = pose_densities.pose_lattice(grid, spacing, 0.3)
    step = round(spacing / 0.1)
    assert free.shape == (-(-120 // step), -(-160 // step))
    assert extent == pytest.approx((free.shape[1] * step * 0.1, free.shape[0] * step * 0.1))
    assert poses.shape == (free.size, 3) and (poses[:, 2] == 0.3).all()
    col, row = np.floor(grid.world_to_cells(poses[:, :2])).astype(int).T
    own_row, own_col = np.indices(free.shape).reshape(2, -1)
    assert np.array_equal(row // step, own_row) and np.array_equal(col // step, own_col)
    assert grid.free[row[free.ravel()], col[free.ravel()]].all()
    tiles = {(r // step, c // step) for r, c in np.argwhere(grid.free)}
    assert set(map(tuple, np.argwhere(free))) == tiles


def test_density_is_drawn_where_its_poses_are():
    grid = gs.OccupancyGrid(np.zeros((20, 30), np.int8), 0.1, TURNED)
    poses, free, extent = pose_densities.pose_lattice(grid, 0.2, 0.0)
    log_p = np.full(free.shape, -50.0)
    log_p[2:4, 11:13] = -10.0
    log_p[7, 4] = np.nan
    figure, ax = new_axes()
    plots.draw_map(ax, grid)
    image = pose_densities.draw_pose_density(ax, grid, log_p, extent, depth=40)
    assert image.get_clim() == (-40.0, 0.0)
    x, y = poses.reshape(*free.shape, 3)[2:4, 11:13, :2].mean(axis=(0, 1))
    assert colour_at(figure, ax, x, y) == pytest.approx(to_rgb(drawing.SCALE[-1]), abs=0.02)
    x, y = poses.reshape(*free.shape, 3)[6, 8, :2]
    assert colour_at(figure, ax, x, y) == pytest.approx(to_rgb(drawing.SCALE[0]), abs=0.02)


@pytest.mark.parametrize("suffix", ["png", "PDF", "svg"])
def test_save_writes_the_format_of_the_ending(suffix, tmp_path):
    figure, ax = new_axes()
    plots.draw_map(ax, lone_cell(TURNED))
    plots.save(figure, tmp_path / f"map.{suffix}")
    head = (tmp_path / f"map.{suffix}").read_bytes()[:40]
    assert {"png": b"\x89PNG", "PDF": b"%PDF", "svg": b"<?xml"}[suffix] in head
    assert len(list(tmp_path.iterdir())) == 1


def test_save_leaves_the_old_file_when_drawing_fails(tmp_path, monkeypatch):
    figure, _ = new_axes()
    path = tmp_path / "map.png"
    path.write_bytes(b"old")

    def fail(stream, **options):
        stream.write(b"half")
        raise RuntimeError("renderer stopped")

    monkeypatch.setattr(figure, "savefig", fail)
    with pytest.raises(RuntimeError, match="renderer stopped"):
        plots.save(figure, path)
    assert path.read_bytes() == b"old"
    assert [file.name for file in tmp_path.iterdir()] == ["map.png"]


@pytest.mark.parametrize(
    ("name", "error", "message"),
    [
        ("map.xyz", ValueError, "path: must end in one of "),
        ("map", ValueError, "path: must end in one of "),
        ("missing/map.png", FileNotFoundError, "missing"),
        ("", ValueError, "path: must be a non-empty path"),
        (3, TypeError, "path: must be a path, got 3"),
    ],
)
def test_save_refuses(name, error, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    figure, _ = new_axes()
    with pytest.raises(error, match=message):
        plots.save(figure, name)
    assert list(tmp_path.iterdir()) == []
