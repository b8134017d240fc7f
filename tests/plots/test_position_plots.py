"""Pictures of possible positions: curves pass through the truth, densities equal SciPy's, files are written."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from gpusense.plots import drawing as plots
from gpusense.plots import positions as position_plots

XY = np.array([(1.0, 1.0), (8.0, 2.0), (4.5, 7.0)]) + np.array([5e5, -3e5])
POSE = np.array([4.0 + 5e5, 3.5 - 3e5, 2.9])
OFFSET = XY - POSE[:2]
RANGES, BEARINGS = np.hypot(*OFFSET.T), np.arctan2(OFFSET[:, 1], OFFSET[:, 0]) - POSE[2]
EXTENT = (5e5 - 1, 5e5 + 10, -3e5 - 3, -3e5 + 8)


def axes():
    ax = plots.new_figure(5.0, 5.0).subplots()
    position_plots.set_view(ax, EXTENT, "a title")
    return ax


@pytest.mark.parametrize(
    ("measured", "curves"),
    [
        ({"ranges": RANGES}, 3),
        ({"bearings": BEARINGS}, 3),
        ({"bearings": BEARINGS, "heading": POSE[2]}, 3),
        ({"ranges": RANGES, "bearings": BEARINGS}, 6),
    ],
    ids=["circles", "arcs", "rays", "both"],
)
def test_curves_go_through_the_truth_and_fit_their_measurement(measured, curves):
    ax = axes()
    assert position_plots.draw_solution_set(ax, XY, **measured) == curves
    (collection,) = ax.collections
    for points in collection.get_segments():
        # Curves consist of chords of at most 1/100 of their length.
        ends = points[1:] - points[:-1]
        along = np.clip(np.sum((POSE[:2] - points[:-1]) * ends, axis=1) / np.sum(ends**2, axis=1), 0, 1)
        assert np.hypot(*(points[:-1] + along[:, None] * ends - POSE[:2]).T).min() < 1e-3
    assert ax.get_xlim() == EXTENT[:2] and ax.get_ylim() == EXTENT[2:]


def test_points_of_an_arc_see_the_angle_between_two_beacons():
    ax = axes()
    position_plots.draw_solution_set(ax, XY[:2], bearings=BEARINGS[:2])
    (arc,) = ax.collections[0].get_segments()
    inner = arc[1:-1, 0] + 1j * arc[1:-1, 1]
    first, second = XY[:2, 0] + 1j * XY[:2, 1]
    seen = np.angle((second - inner) / (first - inner) * np.exp(-1j * (BEARINGS[1] - BEARINGS[0])))
    np.testing.assert_allclose(seen, 0, atol=1e-6)


@pytest.mark.parametrize("heading", [None, POSE[2]], ids=["unknown", "known"])
def test_log_density_is_the_product_of_gaussians(heading):
    """The truth is by SciPy's densities; an unknown heading takes the best of a fine lattice of headings."""
    points = position_plots.tile_centers(EXTENT, 12)
    rho = np.hypot(*np.moveaxis(XY - points[..., None, :], -1, 0))
    found = position_plots.position_log_density(points, XY, ranges=RANGES, sigma_range=[0.2, 0.3, 0.4])
    wanted = stats.norm.logpdf(RANGES, rho, [0.2, 0.3, 0.4]).sum(axis=-1)
    np.testing.assert_allclose(found, wanted, rtol=1e-9)
    assert found.shape == points.shape[:2]
    seen = np.arctan2(XY[:, 1] - points[..., None, 1], XY[:, 0] - points[..., None, 0])
    thetas = np.linspace(-np.pi, np.pi, 4001) if heading is None else np.array([heading])
    best = np.full(found.shape, -np.inf)
    for theta in thetas:
        off = np.angle(np.exp(1j * (BEARINGS - seen + theta)))
        best = np.maximum(best, stats.norm.logpdf(off, 0, 0.3).sum(axis=-1))
    bearings = position_plots.position_log_density(points, XY, bearings=BEARINGS, heading=heading, sigma_bearing=0.3)
    # If residuals nearly wrap, two headings are good; the start at the circular mean may find either.
    near = best > best.max() - 12
    np.testing.assert_allclose(bearings[near], best[near], atol=1e-9 if heading else 1e-4)
    assert (bearings <= best + 1e-4).all()
    both = position_plots.position_log_density(
        points, XY, ranges=RANGES, bearings=BEARINGS, heading=heading, sigma_range=0.2, sigma_bearing=0.3
    )
    alone = position_plots.position_log_density(points, XY, ranges=RANGES, sigma_range=0.2)
    np.testing.assert_allclose(both, alone + bearings, rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "ranges: must be given where bearings are not, got None"),
        ({"ranges": [1, 2, 3]}, "sigma_range: must be given with ranges, got None"),
        ({"bearings": [1, 2, 3]}, "sigma_bearing: must be given with bearings, got None"),
        ({"ranges": [1, 2, 3], "sigma_range": 0}, "sigma_range: must be > 0, got 0.0"),
        ({"points": 0.0, "ranges": [1, 2, 3], "sigma_range": 1}, "points: shape must be (..., 2), got ()"),
    ],
)
def test_bad_input(options, message):
    with pytest.raises(ValueError) as caught:
        position_plots.position_log_density(**{"points": [0.0, 0.0], "xy": XY, **options})
    assert str(caught.value) == message
