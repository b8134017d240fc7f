"""Draw the result of a localisation from one scan as a figure of four maps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense.plots.drawing import (
    ROBOT,
    add_colour_bar,
    draw_map,
    draw_pose,
    draw_scan,
    new_figure,
)
from gpusense.plots.pose_densities import draw_particles, draw_pose_density
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Scanner

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


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

    Args:
        grid: The map.
        scanner: The scanner's geometry.
        ranges: (K,) readings [m].
        truth: (3,) the robot's true pose in the world [m, m, rad].
        best: (3,) the pose for drawing the scan [m, m, rad].
        poses: (N, 3) particles [m, m, rad].
        log_p: (N,) log-likelihoods of the particles.
        densities: Two (R, C) log-likelihoods over a :func:`pose_lattice`, by title.
        extent: (W, H) of that lattice [m].
    """
    figure = new_figure(15.0, 9.8)
    axes = figure.subplots(2, 2)
    for ax in axes.flat:
        draw_map(ax, grid)
    drawn = draw_scan(axes[0, 0], grid, scanner, best, ranges)
    axes[0, 0].set_title(f"The scan at the best particle: {drawn} ranges of {scanner.count} beams", loc="left")
    x, y, _ = checks.array("truth", truth, (3,)).tolist()
    _draw_zoomed_particles(axes[0, 1], grid, (x, y), poses, log_p)
    for ax, (title, density) in zip(axes[1], densities.items(), strict=True):
        image = draw_pose_density(ax, grid, density, extent)
        add_colour_bar(ax, image, "log P(z | x, m) below its maximum [nats]")
        draw_pose(ax, (x, y, 0.0), length=0.0)
        ax.set_title(title, loc="left")
    return figure


def _draw_zoomed_particles(
    ax: Axes, grid: OccupancyGrid, truth: tuple[float, float], poses: ArrayLike, log_p: ArrayLike
) -> None:
    """Draw particles onto a map, with an inset around the true position."""
    x, y = truth
    zoom = ax.inset_axes((0.735, 0.655, 0.255, 0.325))
    draw_map(zoom, grid)
    zoom.set(xlim=(x - 1.5, x + 1.5), ylim=(y - 1.3, y + 1.3), xticks=[], yticks=[], xlabel="", ylabel="")
    for each, size in ((ax, 2.0), (zoom, 3.0)):
        cloud = draw_particles(each, poses, log_p, size=size)
    ax.indicate_inset_zoom(zoom, edgecolor=ROBOT, alpha=1.0)
    add_colour_bar(ax, cloud, "log P(z | x, m) [nats]")
    ax.set_title("The particles and their likelihood by the beam model", loc="left")
