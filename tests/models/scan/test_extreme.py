"""Extreme sizes and directions: a 20 000 x 20 000 map, denormal components of directions."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

import gpusense as gs
from gpusense.evaluation.tolerances import differing

PRECISIONS = ("float32", "float64")
# Denormal in float32, denormal in both precisions, and on both sides of the limit that a ray rounds to 0.
TINY = (5e-324, 1e-310, 1e-45, 1e-40, 1.1e-38, 1e-37, 0.99e-30)
MODELS = {
    "beam": (gs.BeamModel, gs.BeamParameters()),
    "field": (gs.LikelihoodFieldModel, gs.LikelihoodFieldParameters(sigma_hit=0.5)),
}


def room(rows: int = 98, cols: int = 98, cell: float = 0.125) -> gs.OccupancyGrid:
    """Return an empty room with walls of one cell."""
    return gs.OccupancyGrid(np.pad(np.zeros((rows, cols), np.int8), 1, constant_values=100), cell)


def look_around(beams: int, range_max: float = 20.0) -> gs.Scanner:
    return gs.Scanner(np.linspace(-math.pi, math.pi, beams, endpoint=False), range_max)


@pytest.mark.long
def test_a_map_of_20_000_x_20_000_cells(needs):
    side, cell, reach, range_max = 20_000, 0.125, 100, 10.0
    cells = np.zeros((side, side), np.int8)
    cells[::60], cells[:, ::70] = 100, 100
    cells[30::60, ::70] = 0  # Doors.
    grid, scanner = gs.OccupancyGrid(cells, cell), look_around(24, range_max)
    del cells
    poses = np.random.default_rng(5).uniform((1500, 800, -4), (1503, 803, 4), (50, 3))
    # A map of the visible part, with an exact origin.
    row, col = int(800 / cell) - reach, int(1500 / cell) - reach
    part = gs.OccupancyGrid(
        grid.cells[row : row + 2 * reach + 24, col : col + 2 * reach + 24], cell, (col * cell, row * cell, 0)
    )
    backend = needs("opencl")
    for kind, parameters in MODELS.values():
        model, small = (kind(g, scanner, parameters, backend=b) for g, b in ((grid, backend), (part, "numpy")))
        if kind is gs.BeamModel:
            ranges = model.expected_ranges(poses)
            assert differing(ranges, small.expected_ranges(poses)) == 0
            assert (ranges < range_max).mean() > 0.5
        log_p = model.log_likelihood(poses, ranges[0])
        assert np.isfinite(log_p).all()
        np.testing.assert_allclose(log_p, small.log_likelihood(poses, ranges[0]), rtol=0, atol=4e-3)
        assert "of 20000 x 20000 cells" in model.explain()


@pytest.mark.long_on("warp")
@pytest.mark.parametrize("precision", PRECISIONS)
def test_tiny_headings_bearings_and_places(backend, precision):
    tiny = np.array([sign * t for t in (0.0, *TINY, 1e-29, 1e-20, 1e-8) for sign in (1, -1)])
    quarters = np.arange(-2, 3) * (math.pi / 2)
    headings = np.concatenate([tiny, quarters, quarters + 1e-16, [2e6 * math.pi]])
    places = [(4.0, 5.0), (4.0 + 1e-40, 5.0), (1e-40, 1e-310), (-1e-40, 5.0), (0.125, -1e-45), (6.3, 5.7)]
    poses = np.array([(*place, heading) for place, heading in itertools.product(places, headings)])
    grid, scanner = room(), gs.Scanner(np.concatenate([tiny, quarters, -tiny[2:] / 2]), 20.0)
    results = []
    for selection in (backend, "numpy"):
        options = {"backend": selection, "precision": precision}
        beam, field = (kind(grid, scanner, parameters, **options) for kind, parameters in MODELS.values())
        ranges = beam.expected_ranges(poses)
        field_p, field_parts = field.log_likelihood(poses, ranges[0], per_beam=True)
        results.append((ranges, field_p, field_parts, beam.log_likelihood(poses, ranges[0])))
    (ranges, field_p, field_parts, beam_p), (same_ranges, same_field_p, same_field_parts, same_beam_p) = results
    assert all(np.isfinite(values).all() for values in results[0])
    assert differing(ranges, same_ranges) == 0
    assert differing(field_parts, same_field_parts) == 0
    assert differing(field_p, same_field_p) == 0
    np.testing.assert_allclose(beam_p, same_beam_p, rtol=0, atol=4e-3 if precision == "float32" else 1e-9)
    # Along the axes, tiny headings have the ranges of heading 0.
    tiny_rows = ranges.reshape(len(places), len(headings), -1)[:, : 2 * (1 + len(TINY)), : len(tiny)]
    assert (tiny_rows[0] == tiny_rows[0, 0, 0]).all()


@pytest.mark.parametrize("farthest", [1e30, 1e39, 1e300])
def test_a_largest_distance_beyond_float32(backend, farthest):
    poses = np.random.default_rng(0).uniform((-1, -1, -3), (3, 1.5, 3), (100, 3))
    field = gs.LikelihoodFieldParameters(max_distance=farthest, interpolation="bilinear")
    grid, scanner = gs.OccupancyGrid([[0] * 20 + [100]] * 6, 0.1), gs.Scanner([0.0, 1.0], 4.0)
    found, right = (
        gs.LikelihoodFieldModel(grid, scanner, field, **options).log_likelihood(poses, [1.5, 0.7])
        for options in ({"backend": backend}, {"backend": "numpy", "precision": "float64"})
    )
    np.testing.assert_allclose(found, right, atol=1e-5)
