"""Extreme sizes and directions: long scans, large clouds, a 20 000 x 20 000 map, denormal components of directions."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.evaluation.tolerances import differing, per_scan

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
@pytest.mark.parametrize(("beams", "particles"), [(100_000, 50), (200, 20_000)])
@pytest.mark.parametrize("name", MODELS)
def test_weights_of_long_scans_and_of_many_particles(backend, name, beams, particles):
    kind, parameters = MODELS[name]
    grid, scanner, pose = room(), look_around(beams), np.array([[4.0, 5.0, 0.3]])
    particles //= 10 if get_backend(backend).info.backend == "numpy" else 1
    ranges = gs.RayCaster(grid, 20.0, backend=backend).cast(pose, scanner.bearings)[0]
    poses = pose + np.random.default_rng(7).normal(0, (0.3, 0.3, 0.1), (particles, 3))
    model = kind(grid, scanner, parameters, backend=backend)
    log_p = model.log_likelihood(poses, ranges)
    assert log_p.shape == (particles,)
    assert np.isfinite(log_p).all()
    made = gs.normalize_weights(log_p)
    assert not made.degenerate
    assert math.fsum(made.weights) == pytest.approx(1, abs=1e-6)
    assert 1 <= made.effective_sample_size <= particles
    # The exact sum of the same beams.
    again, parts = model.log_likelihood(poses[:3], ranges, per_beam=True)
    assert differing(again, log_p[:3]) == 0
    exact = np.array([math.fsum(row) for row in parts.tolist()])
    assert (np.abs(again - exact) <= per_scan(parts, "float32")).all()
    if beams == 100_000:
        # A product of densities would be 0, or infinity where densities are above 1.
        with np.errstate(over="ignore"):
            product = np.exp(log_p.astype(np.float64))
        assert ((product == 0) | np.isinf(product)).all()


@pytest.mark.slow
@pytest.mark.sampled(0.5)
@pytest.mark.parametrize("name", MODELS)
def test_ten_million_particles(name, needs):
    kind, parameters = MODELS[name]
    model = kind(room(), gs.Scanner([0.25], 20.0), parameters, backend=needs("opencl"))
    poses = np.random.default_rng(3).uniform((1, 1, -4), (11, 11, 4), (10_000_000, 3))
    log_p = model.log_likelihood(poses, [2.5])
    assert np.isfinite(log_p).all()
    for some in (slice(0, 1000), slice(5_000_000, 5_001_000), slice(-1000, None)):
        assert differing(model.log_likelihood(poses[some], [2.5]), log_p[some]) == 0
    made = gs.normalize_weights(log_p)
    assert made.weights.sum() == pytest.approx(1, abs=1e-6)
    assert 1 <= made.effective_sample_size <= len(poses)


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
