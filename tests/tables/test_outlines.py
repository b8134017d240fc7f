"""Normals near corners, on bends and at the ends of walls, and the share of sonars in a room without a return."""

from __future__ import annotations

import math

import numpy as np
import pytest

import gpusense as gs

TURNS = (0.0, 0.05, 0.2, 0.4, 0.55, math.pi / 4, 1.1, 1.4)


class Room:
    """A room of width x height cells at any angle in the middle of a map, with walls of any thickness, or a block."""

    def __init__(self, turn: float, size: tuple[float, float], thick: float = math.inf, block: bool = False):
        self.turn, self.half, self.thick = turn, (size[0] / 2, size[1] / 2), thick
        side = int(math.hypot(*size)) + 30
        self.middle = side / 2 + 0.3
        x, y = np.meshgrid(*2 * [np.arange(side) + 0.5 - self.middle])
        c, s = math.cos(turn), math.sin(turn)
        # Distance beyond the room along its two axes.
        self.beyond = np.abs([c * x + s * y, c * y - s * x]) - np.array(self.half)[:, None, None]
        inside = (self.beyond < 0).all(axis=0)
        occupied = inside if block else ~inside & (self.beyond < thick).all(axis=0)
        self.grid = gs.OccupancyGrid(100 * occupied, 1.0)

    def errors(self) -> tuple[np.ndarray, np.ndarray]:
        """Return errors of normals [degrees] and distances from the nearest corner [cells].

        Within a cell of both walls, either direction is right.
        """
        outside = "occupied" if self.thick == math.inf else "free"
        normals = gs.surface_normals(self.grid, outside=outside)
        c, s = math.cos(self.turn), math.sin(self.turn)
        along = np.abs([normals @ (c, s), normals @ (-s, c)])
        surfaces = [0.0] if self.thick == math.inf else [0.0, self.thick]
        far = np.min([np.abs(self.beyond - surface) for surface in surfaces], axis=0)
        known = ~np.isnan(normals[..., 0]) & (far.min(axis=0) < 1.25)
        best = np.where(far < 1.25, along, 0).max(axis=0)[known]
        corner = np.min([np.hypot(*(self.beyond - surface)) for surface in surfaces], axis=0)[known]
        return np.degrees(np.arccos(np.minimum(best, 1))), corner


@pytest.mark.parametrize("thick", [math.inf, 1.5, 4.0])
@pytest.mark.parametrize("turned", [False, True])
def test_normals_near_the_corners_of_rooms(turned, thick, record_property):
    """Before outlines: 36 degrees within a cell of a corner, 27 up to two cells, 12 up to four."""
    found = [
        Room(turn, size, thick).errors()
        for turn in (TURNS[1:] if turned else TURNS[:1])
        for size in ((41.3, 57.9), (33.8, 64.2))
    ]
    errors, corner = np.concatenate(found, axis=1)
    for low, high, mean in ((1, 2, 4), (2, 4, 2.5), (4, 6, 2), (6, 10, 1.2), (10, math.inf, 1)):
        each = errors[(low <= corner) & (corner < high)]
        record_property(f"mean error {low} to {high} cells from a corner", float(each.mean()))
        assert len(each) and each.mean() <= mean
    # The outer corner of a wall is one cell with a normal between both; the corner of a solid room is none.
    if thick == math.inf:
        assert errors[corner < 1].mean() <= 5
        assert turned or errors.max() <= 1.5


def test_normals_at_the_corners_of_blocks():
    errors, corner = np.concatenate([Room(turn, (41.3, 57.9), block=True).errors() for turn in TURNS], axis=1)
    for low, high, mean in ((2, 4, 2.5), (4, 6, 2), (6, math.inf, 1)):
        assert errors[(low <= corner) & (corner < high)].mean() <= mean


@pytest.mark.parametrize("radius", [5, 6, 7, 9, 16, 20, 25, 32])
@pytest.mark.parametrize("solid", [True, False])
def test_bends_are_not_taken_for_corners(radius, solid):
    side = 2 * radius + 41
    x, y = np.meshgrid(np.arange(side) + 0.5 - side / 2, np.arange(side) + 0.7 - side / 2)
    far = np.hypot(x, y)
    normals = gs.surface_normals(gs.OccupancyGrid(100 * ((far <= radius) == solid), 1.0), outside="occupied")
    known = ~np.isnan(normals[..., 0]) & (np.abs(far - radius) < 2)
    outwards = (normals * np.stack([x, y], axis=-1)).sum(axis=-1)[known] / far[known]
    error = np.degrees(np.arccos(np.minimum(outwards if solid else -outwards, 1)))
    assert known.sum() >= 5 * radius
    assert error.mean() <= 3.2 and error.max() <= 9


@pytest.mark.parametrize("thick", [1, 2, 3])
def test_the_end_of_a_wall_has_the_direction_of_the_wall(thick):
    """This holds up to the last cell but one; the last cell has sides of both directions."""
    cells = np.zeros((40, 60), int)
    cells[20 : 20 + thick, :30] = 100
    normals = gs.surface_normals(gs.OccupancyGrid(cells, 1.0), outside="occupied")[20 : 20 + thick, 5:29]
    sides = normals[[0, -1]]
    assert np.abs(sides[..., 0]).max() <= math.sin(math.radians(1.5))
    if thick > 1:
        np.testing.assert_allclose(sides[..., 1], [[-1] * 24, [1] * 24], atol=1e-3)


# ------------------------------------------------------------------------------------------------------------- sonars

CRITICAL, RANGE, SIZE = 0.4, 10.0, (5.0, 4.0)


def analytic(scanner: gs.Scanner, poses: np.ndarray) -> np.ndarray:
    """Return the expected ranges of cones in a room of SIZE around the origin with mirror walls."""
    angle = poses[:, 2, None] + np.asarray(scanner.ray_bearings).reshape(-1)
    dx, dy = np.cos(angle), np.sin(angle)
    tx = (np.sign(dx) * SIZE[0] / 2 - poses[:, :1]) / dx
    ty = (np.sign(dy) * SIZE[1] / 2 - poses[:, 1:2]) / dy
    heard = np.where(tx < ty, np.abs(dx), np.abs(dy)) >= math.cos(CRITICAL)
    ranges = np.where(heard, np.minimum(tx, ty), RANGE)
    return ranges.reshape(len(poses), -1, scanner.cone_rays).min(axis=-1)


@pytest.mark.parametrize("rays", [3, 9, 33])
@pytest.mark.parametrize("turn", [0.0, 0.1, 0.35, math.pi / 4])
def test_sonars_in_a_room_hear_as_geometry_says(turn, rays, record_property):
    """Without outlines, 36 % of these cones had no return, but 28 % in the model, and fewer with more rays."""
    rng = np.random.default_rng(3)
    poses = np.column_stack([rng.uniform(-0.45, 0.45, (250, 2)) * SIZE, rng.uniform(-math.pi, math.pi, 250)])
    c, s = math.cos(turn), math.sin(turn)
    centre = np.arange(-75, 75) * 0.05 + 0.025
    x, y = np.meshgrid(centre, centre)
    inside = (np.abs(c * x + s * y) < SIZE[0] / 2) & (np.abs(c * y - s * x) < SIZE[1] / 2)
    grid = gs.OccupancyGrid(100 * ~inside, 0.05, (-3.75, -3.75, 0.0))
    bearings = np.linspace(-math.pi, math.pi, 16, endpoint=False)
    scanner = gs.Scanner(bearings, RANGE, cone=0.26, cone_rays=rays, critical_incidence=CRITICAL)
    turned = poses @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + (0, 0, turn)
    found = gs.BeamModel(grid, scanner, backend="numpy").expected_ranges(turned)
    known = analytic(scanner, poses)
    silent, truth = found >= RANGE, known >= RANGE
    record_property("without return", float(silent.mean()))
    record_property("without return, analytic", float(truth.mean()))
    assert truth.mean() > 0.3
    assert abs(silent.mean() - truth.mean()) <= (0.002 if turn == 0 else 0.008)
    assert (silent != truth).mean() <= (0.003 if turn == 0 else 0.02)
