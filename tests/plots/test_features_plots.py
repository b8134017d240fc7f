"""Pictures show each feature and landmark once."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.feature_scenes import floor_plan

import gpusense as gs


def test_all_kinds_are_drawn_with_one_label_each():
    scanner = gs.Scanner(np.linspace(-math.pi, math.pi, 720, endpoint=False), range_max=20.0)
    floor = floor_plan(4)
    scans, _ = floor.cast(floor.poses(12, 4), scanner.bearings)
    features = gs.extract_features(scans, scanner, backend="numpy")
    k = int(np.argmax([len(set(features.of_scan(k).kind)) for k in range(12)]))
    one = features.of_scan(k)
    figure = gs.plots.features_figure(one, scans[k], scanner)
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
    (ax,) = gs.plots.landmarks_figure(landmarks, grid).axes
    (dots,) = [line for line in ax.lines if line.get_label() == "corner"]
    np.testing.assert_allclose(np.column_stack(dots.get_data()), landmarks.landmarks("corner").xy)
    drawn = [np.column_stack(line.get_data()).ravel() for line in ax.lines if len(line.get_xdata()) == 2]
    for wall in landmarks.lines().segments:
        assert any(np.array_equal(wall, one) for one in drawn)
