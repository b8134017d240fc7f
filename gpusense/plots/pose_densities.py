"""Draw particles, likelihoods of poses, and likelihood fields; see :mod:`gpusense.plots.drawing`."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util import checks
from gpusense.matching.pose_likelihood import PoseLikelihood
from gpusense.plots.drawing import (
    ROBOT,
    _over_grid,
    add_colour_bar,
    colours,
    draw_map,
    draw_pose,
    draw_scan,
    new_figure,
    save,
)
from gpusense.tables.distances import distance_transform
from gpusense.world.field_density import FieldDensity
from gpusense.world.grid import OccupancyGrid
from gpusense.world.parameters import LikelihoodFieldParameters
from gpusense.world.scanner import Scanner

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import PathCollection
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage


def draw_particles(
    ax: Axes, poses: ArrayLike, log_p: ArrayLike, *, size: float = 3.0, depth: float | None = None
) -> PathCollection:
    """Draw particles coloured by their log-likelihood, the likeliest on top.

    Args:
        ax: Axes to draw onto.
        poses: (N, 3) x, y and theta in the world [m, m, rad].
        log_p: (N,) log-likelihoods, natural logarithm; -inf takes the colour of the scale's low end.
        size: Area of a particle [points squared].
        depth: Extent of the colour scale below the best value [nats]; the default covers half of the particles.

    Returns:
        The collection, for :func:`add_colour_bar`.

    Example:
        >>> import gpusense as gs
        >>> ax = gs.plots.new_figure(6.0, 4.0).subplots()
        >>> poses = [(0.0, 0.0, 0.0), (1.0, 2.0, 0.5)]
        >>> gs.plots.draw_particles(ax, poses, [-3.0, -1.0]).get_offsets().tolist()
        [[0.0, 0.0], [1.0, 2.0]]
    """
    position = checks.array("poses", poses, ("N", 3))[:, :2]
    value = checks.array("log_p", log_p, (len(position),), finite=False)
    low, high = _scale(value, depth)
    order = np.argsort(value, kind="stable")
    return ax.scatter(
        position[order, 0], position[order, 1], s=size, c=np.maximum(value[order], low), cmap=colours(), vmin=low,
        vmax=high, linewidths=0, rasterized=True, zorder=3,
    )  # fmt: skip


def pose_lattice(
    grid: OccupancyGrid, spacing: float, theta: float
) -> tuple[NDArray[np.float64], NDArray[np.bool], tuple[float, float]]:
    """Make a lattice of poses with one heading ``theta`` over a map, along the grid's axes.

    ``spacing``: Distance between neighbours, rounded to whole cells [m].

    Returns:
        (R C, 3) poses row by row, (R, C) whether the pose's tile has a free cell, and the lattice's extent (W, H)
        along the grid's axes [m]. A pose is in the free cell nearest to the middle of its tile.
    """
    step = max(round(checks.real("spacing", spacing, above=0) / grid.resolution), 1)
    rows, cols = (-(-count // step) for count in grid.shape)
    padded = np.zeros((rows * step, cols * step), bool)
    padded[: grid.shape[0], : grid.shape[1]] = grid.free
    tiles = padded.reshape(rows, step, cols, step).swapaxes(1, 2).reshape(rows, cols, step * step)
    within = np.stack(np.divmod(np.arange(step * step), step))
    order = np.argsort(((within - (step - 1) / 2) ** 2).sum(axis=0), kind="stable")
    chosen = within[:, order[tiles[:, :, order].argmax(axis=2)]]
    row, col = (np.indices((rows, cols)) * step + chosen).reshape(2, -1)
    poses = np.column_stack([grid.cell_centers(row, col), np.full(rows * cols, checks.real("theta", theta))])
    extent = (cols * step * grid.resolution, rows * step * grid.resolution)
    free: NDArray[np.bool] = tiles.max(axis=2)
    return poses, free, extent


def draw_pose_density(
    ax: Axes, grid: OccupancyGrid, log_p: ArrayLike, extent: tuple[float, float], *, depth: float | None = None
) -> AxesImage:
    """Draw (R, C) log-likelihoods over a :func:`pose_lattice` relative to the best; NaN stays blank.

    ``depth``: Extent of the colour scale [nats]; the default covers half of the values.
    """
    value = checks.array("log_p", log_p, ("R", "C"), finite=False)
    low, high = _scale(value[~np.isnan(value)], depth)
    below = np.maximum(value, low) - high
    return _over_grid(ax, grid, below, extent, cmap=colours(), vmin=low - high, vmax=0.0, zorder=1)


def _scale(value: NDArray[np.float64], depth: float | None) -> tuple[float, float]:
    """Return the ends of a colour scale for log-likelihoods."""
    finite = value[np.isfinite(value)]
    if finite.size == 0:
        return -1.0, 0.0
    high = float(finite.max())
    low = float(np.quantile(finite, 0.5)) if depth is None else high - checks.real("depth", depth, above=0)
    return min(low, high - 1.0), high


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
    rows, cols = best.shape
    extent = (cols * likelihood.resolution, rows * likelihood.resolution)
    return draw_pose_density(ax, likelihood.grid, np.where(np.isneginf(best), np.nan, best), extent, depth=depth)


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


def localization_figure(
    grid: OccupancyGrid,
    scanner: Scanner,
    ranges: ArrayLike,
    truth: ArrayLike,
    best: ArrayLike,
    poses: ArrayLike,
    log_p: ArrayLike,
    densities: Mapping[str, ArrayLike],
    extent: tuple[float, float],
) -> Figure:
    """Draw four maps: a scan at the best pose, particles with an inset around the truth, and two densities.

    ``truth``, ``best``: (3,) poses. ``poses``, ``log_p``: N particles and their log-likelihoods. ``densities``: Two
    (R, C) log-likelihoods over a :func:`pose_lattice` of this extent, by title.
    """
    figure = new_figure(15.0, 9.8)
    # A constrained layout takes a third of the picture's time: it measures all ticks. So does a title without a height.
    figure.set_layout_engine("none")
    axes = figure.subplots(
        2, 2, gridspec_kw=dict(left=0.044, right=0.9375, bottom=0.07, top=0.944, wspace=0.28, hspace=0.19)
    )
    for ax in axes.flat:
        draw_map(ax, grid)
    drawn = draw_scan(axes[0, 0], grid, scanner, best, ranges)
    axes[0, 0].set_title(f"The scan at the best particle: {drawn} ranges of {scanner.count} beams", loc="left", y=1.0)
    x, y, _ = checks.array("truth", truth, (3,)).tolist()
    _draw_zoomed_particles(axes[0, 1], grid, (x, y), poses, log_p)
    for ax, (title, density) in zip(axes[1], densities.items(), strict=True):
        image = draw_pose_density(ax, grid, density, extent)
        add_colour_bar(ax, image, "log P(z | x, m) below its maximum [nats]")
        draw_pose(ax, (x, y, 0.0), length=0.0)
        ax.set_title(title, loc="left", y=1.0)
    return figure


def _draw_zoomed_particles(
    ax: Axes, grid: OccupancyGrid, truth: tuple[float, float], poses: ArrayLike, log_p: ArrayLike
) -> None:
    """Draw particles onto a map, with an inset around the true position."""
    x, y = truth
    zoom = ax.inset_axes((0.735, 0.655, 0.255, 0.325))
    zoom.set_in_layout(False)
    zoom.set_title("", y=1.0)
    draw_map(zoom, grid)
    zoom.set(xlim=(x - 1.5, x + 1.5), ylim=(y - 1.3, y + 1.3), xticks=[], yticks=[], xlabel="", ylabel="")
    for each, size in ((ax, 2.0), (zoom, 3.0)):
        cloud = draw_particles(each, poses, log_p, size=size)
    ax.indicate_inset_zoom(zoom, edgecolor=ROBOT, alpha=1.0)
    add_colour_bar(ax, cloud, "log P(z | x, m) [nats]")
    ax.set_title("The particles and their likelihood by the beam model", loc="left", y=1.0)
