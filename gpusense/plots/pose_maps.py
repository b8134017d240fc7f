"""Draw likelihoods of poses, and likelihood fields of maps and scans; see :mod:`gpusense.plots.drawing`."""

from __future__ import annotations

import math
import os
from typing import TYPE_CHECKING

import numpy as np

from gpusense._util import checks
from gpusense.matching.pose_likelihood import PoseLikelihood
from gpusense.plots.drawing import (
    _over_grid,
    add_colour_bar,
    colours,
    draw_map,
    draw_pose,
    new_figure,
    save,
)
from gpusense.plots.pose_densities import _scale
from gpusense.tables.distances import distance_transform
from gpusense.world.field_density import FieldDensity
from gpusense.world.grid import OccupancyGrid
from gpusense.world.parameters import LikelihoodFieldParameters

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.image import AxesImage


def draw_pose_likelihood(ax: Axes, likelihood: PoseLikelihood, *, depth: float | None = None) -> AxesImage:
    """Draw the likelihood of each position at its best heading: the darker a position, the larger P(z | x, m).

    Args:
        ax: Axes to draw onto, usually after :func:`draw_map`.
        likelihood: A result of :func:`gpusense.pose_likelihood`.
        depth: Extent of the colour scale below the best value [nats]; the default covers half of the positions.

    Returns:
        The image, for :func:`add_colour_bar`.

    Example:
        >>> import gpusense as gs
        >>> grid, ax = gs.OccupancyGrid([[0, 0, 100]], 1.0), gs.plots.new_figure(6.0, 4.0).subplots()
        >>> model = gs.LikelihoodFieldModel(grid, gs.Scanner([0.0], range_max=9.0), backend="numpy")
        >>> p = gs.pose_likelihood(model, [1.9], resolution=1.0, headings=4)
        >>> gs.plots.draw_pose_likelihood(ax, p).get_array().shape
        (1, 3)
    """
    best = np.where(np.isnan(likelihood.log_p), -np.inf, likelihood.log_p).max(axis=2).astype(np.float64)
    low, high = _scale(best, depth)
    below = np.where(np.isfinite(best), np.maximum(best, low) - high, np.nan)
    rows, cols = best.shape
    size = (cols * likelihood.resolution, rows * likelihood.resolution)
    image = _over_grid(ax, likelihood.grid, below, size, cmap=colours(), zorder=1, interpolation="nearest")
    image.set_clim(low - high, 0.0)
    return image


def pose_likelihood_figure(likelihood: PoseLikelihood, path: str | os.PathLike[str]) -> None:
    """Draw likelihoods over the map's outlines, with all modes near the best one, and write the picture."""
    grid = likelihood.grid
    figure = new_figure(8.0, 8.0 * min(max(grid.height / grid.width, 0.3), 2.0))
    ax = figure.subplots()
    draw_map(ax, grid)
    image = draw_pose_likelihood(ax, likelihood)
    poses, log_p = likelihood.modes(5)
    for pose, value in zip(poses, log_p, strict=True):
        if value > log_p[0] - 10:
            draw_pose(ax, pose, length=0.05 * math.hypot(grid.width, grid.height))
    add_colour_bar(ax, image, "log P(z | x, m) below the best [nats]")
    near = int((log_p > log_p[0] - 3).sum()) if len(log_p) else 0
    ax.set_title(f"{near or 'no'} place{'s' * (near != 1)} within 3 nats of the best; rings: local maxima", loc="left")
    save(figure, path)


def draw_likelihood_field(
    ax: Axes, grid: OccupancyGrid, parameters: LikelihoodFieldParameters | None = None, *, range_max: float = 30.0
) -> AxesImage:
    """Draw the likelihood field of a map: the darker a point, the likelier a range ends there (figure 6.8 inverted).

    Args:
        ax: Axes to draw onto.
        grid: The map.
        parameters: Parameters of the field; ``LikelihoodFieldParameters.tracking()`` by default.
        range_max: Largest range of the scanner, for z_rand [m].

    Returns:
        The image, for :func:`add_colour_bar`.

    Example:
        >>> import gpusense as gs
        >>> ax = gs.plots.new_figure(6.0, 4.0).subplots()
        >>> gs.plots.draw_likelihood_field(ax, gs.OccupancyGrid([[0, 100, 0]], 0.5)).get_array().argmax()
        np.int64(1)
    """
    p = LikelihoodFieldParameters.tracking() if parameters is None else parameters
    distance = distance_transform(grid.occupied, resolution=grid.resolution, backend="numpy")
    density = FieldDensity(p, checks.real("range_max", range_max, above=0))
    image = _over_grid(ax, grid, density.log(density.capped(distance)), cmap=colours(), interpolation="nearest")
    ax.set_aspect("equal")
    x_min, y_min, x_max, y_max = grid.bounds()
    ax.set(xlim=(x_min, x_max), ylim=(y_min, y_max), xlabel="x [m]", ylabel="y [m]")
    return image
