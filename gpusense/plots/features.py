"""Draw features of scans, and landmarks from features."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense.plots.drawing import add_legend, draw_map, draw_pose, end_points, new_figure
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Scanner

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from gpusense.features.feature_map import FeatureMap
    from gpusense.features.result import Features

POINTS = "#9aa5b1"
COLOURS = {"line": "#1d3557", "corner": "#d7263d", "door": "#b5179e", "hallway": "#2a9d8f", "pole": "#f3722c",
           "reflector": "#ffbe0b"}  # fmt: skip
# Symbols of landmarks.
MARKS = {"corner": "s", "door": "D", "hallway": "^", "pole": "o", "reflector": "*"}
# Length of arrows of directions [m].
_ARROW = 0.5


def draw_features(ax: Axes, features: Features, ranges: ArrayLike, scanner: Scanner) -> None:
    """Draw a scan and its features in the robot's frame.

    Args:
        ax: Axes to draw onto.
        features: Features of this scan.
        ranges: (K,) readings [m].
        scanner: The scanner.

    Raises:
        ValueError: the readings have another shape.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> scanner = gs.Scanner.uniform(angle_min=-3.1, angle_increment=0.0175, count=356, range_max=9.0)
        >>> b = scanner.bearings
        >>> room = np.minimum(3 / np.abs(np.cos(b)), 2 / np.abs(np.sin(b)))
        >>> ax = gs.plots.new_figure(6.0, 4.0).subplots()
        >>> gs.plots.draw_features(ax, gs.extract_features(room, scanner, backend="numpy"), room, scanner)
        >>> ax.get_xlabel()
        'x [m]'
    """
    z = checks.array("ranges", ranges, (scanner.count,), finite=False, dtype=None)
    points = end_points(z, scanner)
    ax.plot(points[:, 0], points[:, 1], ".", color=POINTS, ms=2.5, zorder=2, label="readings")
    shown = set()
    for kind, (x, y, theta), size in zip(features.kind, features.pose, features.size, strict=True):
        label = str(kind) if kind not in shown else None
        shown.add(kind)
        _draw_one(ax, str(kind), (x, y, theta), float(size), label)
    draw_pose(ax, (0.0, 0.0, 0.0), length=_ARROW)
    ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")


def _draw_one(ax: Axes, kind: str, pose: tuple[float, float, float], size: float, label: str | None) -> None:
    """Draw one feature."""
    from matplotlib.patches import Circle

    x, y, theta = pose
    colour = COLOURS[kind]
    c, s = math.cos(theta), math.sin(theta)
    if kind in ("pole", "reflector"):
        ax.add_patch(Circle((x, y), max(size, 0.03), fill=False, color=colour, linewidth=2.0, zorder=8, label=label))
    elif kind in ("line", "door"):
        # A door's theta is the direction across it.
        ahead, aside = (c, s) if kind == "line" else (-s, c)
        ends = np.array([[x, y]]) + np.array([[-0.5], [0.5]]) * size * np.array([[ahead, aside]])
        wide, alpha = (1.6, 1.0) if kind == "line" else (5.0, 0.55)
        ax.plot(ends[:, 0], ends[:, 1], color=colour, linewidth=wide, alpha=alpha, zorder=4, label=label)
    else:
        ax.plot([x, x + _ARROW * c], [y, y + _ARROW * s], color=colour, linewidth=1.5, zorder=8)
        ax.plot([x], [y], MARKS[kind], color=colour, ms=5, zorder=9, label=label)


def draw_landmarks(ax: Axes, landmarks: FeatureMap) -> None:
    """Draw landmarks at their positions in the world, with directions.

    Args:
        ax: Axes to draw onto, for example from :func:`draw_map`.
        landmarks: The landmarks.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> cells = np.zeros((80, 120), np.int8)
        >>> cells[[0, -1]] = cells[:, [0, -1]] = 100
        >>> grid = gs.OccupancyGrid(cells, resolution=0.05)
        >>> ax = gs.plots.new_figure(6.0, 4.0).subplots()
        >>> image = gs.plots.draw_map(ax, grid)
        >>> gs.plots.draw_landmarks(ax, gs.landmarks_of_map(grid, backend="numpy"))
    """
    for kind, colour in COLOURS.items():
        rows = landmarks.kind == kind
        if not rows.any():
            continue
        if kind == "line":
            ends = landmarks.lines().segments.reshape(-1, 2, 2)
            for number, (x, y) in enumerate(ends.transpose(0, 2, 1)):
                ax.plot(x, y, color=colour, lw=1.6, zorder=6, label=kind if number == 0 else None)
            continue
        x, y, theta = landmarks.pose[rows].T
        ax.plot(x, y, MARKS[kind], color=colour, ms=5, zorder=8, label=kind)
        if kind not in ("pole", "reflector"):
            for a, b, t in zip(x, y, theta, strict=True):
                ax.plot([a, a + _ARROW * math.cos(t)], [b, b + _ARROW * math.sin(t)], color=colour, lw=1, zorder=7)


def features_figure(features: Features, ranges: ArrayLike, scanner: Scanner) -> Figure:
    """Draw (K,) readings and the features of their scan, with a legend."""
    figure = new_figure(8.0, 6.0)
    ax = figure.subplots()
    draw_features(ax, features, ranges, scanner)
    add_legend(ax, 7)
    return figure


def landmarks_figure(landmarks: FeatureMap, grid: OccupancyGrid | None = None) -> Figure:
    """Draw landmarks, over a map if any."""
    figure = new_figure(8.0, 8.0)
    ax = figure.subplots()
    if grid is not None:
        draw_map(ax, grid)
    draw_landmarks(ax, landmarks)
    ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    if len(landmarks):
        add_legend(ax, 7)
    return figure
