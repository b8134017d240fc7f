"""Ranges and fields with a closed form: in a rectangular room, and in a disc of pixels."""

from __future__ import annotations

import math

import numpy as np
import pytest

import gpusense as gs

PRECISIONS = ["float32", "float64"]
BEARINGS = np.linspace(-math.pi, math.pi, 361)


def room(resolution: float, origin: tuple[float, float, float]) -> tuple[gs.OccupancyGrid, tuple[int, int, int, int]]:
    """Return a room of 40 x 25 cells with walls of one cell, and its free part (left, bottom, right, top) in cells."""
    cells = np.full((27, 42), 100)
    cells[1:-1, 1:-1] = 0
    return gs.OccupancyGrid(cells, resolution, origin), (1, 1, 41, 26)


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("frame", [(0.05, (0.0, 0.0, 0.0)), (0.25, (12.5, -3.0, 0.0)), (1.0, (1e4, 5e4, 0.7))])
def test_ranges_in_a_rectangle(frame, precision, backend):
    resolution, origin = frame
    grid, (left, bottom, right, top) = room(resolution, origin)
    rng = np.random.default_rng(3)
    local = rng.uniform((left, bottom, -4), (right, top, 4), (80, 3))
    cos, sin = math.cos(origin[2]), math.sin(origin[2])
    x, y = local[:, 0] * resolution, local[:, 1] * resolution
    poses = np.stack([origin[0] + cos * x - sin * y, origin[1] + sin * x + cos * y, local[:, 2] + origin[2]], axis=1)
    caster = gs.RayCaster(grid, 100 * resolution, backend=backend, precision=precision)
    angle = local[:, 2:] + BEARINGS
    with np.errstate(divide="ignore"):
        along_x = np.where(np.cos(angle) > 0, right - local[:, :1], left - local[:, :1]) / np.cos(angle)
        along_y = np.where(np.sin(angle) > 0, top - local[:, 1:2], bottom - local[:, 1:2]) / np.sin(angle)
    expected = np.minimum(along_x, along_y) * resolution
    found = caster.cast(poses, BEARINGS)
    # In float64, world coordinates of 5e4 m have an error of 1e-11 m; a grazing ray magnifies it.
    off = {"float32": 1e-3, "float64": 1e-7 if origin[2] else 1e-11}[precision] * resolution
    np.testing.assert_allclose(found, expected, rtol=1e-6 if precision == "float32" else 1e-12, atol=off)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_ranges_in_a_disc_of_pixels(precision, backend):
    """Cells with centres at least radius cells away are occupied, so entries are off by at most half a diagonal."""
    radius, size = 150.0, 320
    centre = size / 2
    row, col = np.indices((size, size)) + 0.5
    cells = np.where(np.hypot(col - centre, row - centre) >= radius, 100, 0)
    grid = gs.OccupancyGrid(cells, 0.1)
    caster = gs.RayCaster(grid, 40.0, backend=backend, precision=precision)
    rng = np.random.default_rng(4)
    # From the middle all ranges are equal; elsewhere they are secants.
    distance, turn = np.append(0.0, rng.uniform(0, 140, 40)), rng.uniform(-4, 4, 41)
    x, y = distance * np.cos(turn), distance * np.sin(turn)
    poses = np.stack([(centre + x) * 0.1, (centre + y) * 0.1, rng.uniform(-4, 4, 41)], axis=1)
    found = caster.cast(poses, BEARINGS) / 0.1
    # Distance from the disc's middle to the point where the ray ends.
    angle = poses[:, 2:] + BEARINGS
    end = np.hypot(x[:, None] + found * np.cos(angle), y[:, None] + found * np.sin(angle))
    half_diagonal = math.sqrt(0.5)
    assert end.min() > radius - half_diagonal - 1e-3
    assert end.max() < radius + half_diagonal + 1e-3
    np.testing.assert_allclose(found[0], radius, atol=half_diagonal)


@pytest.mark.parametrize("interpolation", ["nearest", "bilinear"])
def test_the_field_beside_a_straight_wall(interpolation, backend):
    """d is the distance of the end point's cell from the wall's, or of the end point itself if it is interpolated."""
    cells = np.zeros((40, 60), int)
    cells[:, 50] = 100
    grid = gs.OccupancyGrid(cells, 0.1)
    p = gs.LikelihoodFieldParameters(sigma_hit=0.3, max_distance=2.0, interpolation=interpolation)
    model = gs.LikelihoodFieldModel(grid, gs.Scanner([0.0], 9.0), p, backend=backend, precision="float64")
    x = np.random.default_rng(5).uniform(1.0, 4.9, 200)
    poses = np.stack([x - 0.5, np.full(200, 2.03), np.zeros(200)], axis=1)
    found = model.log_likelihood(poses, [0.5])
    distance = 5.05 - x if interpolation == "bilinear" else (50 - np.floor(x / 0.1)) * 0.1
    distance = np.minimum(distance, 2.0)
    if interpolation == "bilinear":
        # The cap bends the field within the cell where it begins.
        keep = np.abs(distance - 2.0) > 0.1
        found, distance = found[keep], distance[keep]
    density = p.z_hit * np.exp(-0.5 * (distance / 0.3) ** 2) / (0.3 * math.sqrt(2 * math.pi)) + p.z_rand / 9.0
    np.testing.assert_allclose(found, np.log(density), atol=1e-9)
