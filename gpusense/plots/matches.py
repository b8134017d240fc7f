"""Draw matches of scans: both scans' points before and after."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import masks
from gpusense.plots.drawing import ESTIMATE, OCCUPIED, add_legend, draw_map, new_figure
from gpusense.world.frames import ray_vectors
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Reading, Scanner, classify

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def match_figure(
    reference: ArrayLike | OccupancyGrid, ranges: ArrayLike, scanner: Scanner, guess: ArrayLike, pose: ArrayLike
) -> Figure:
    """Draw the reference, and the second scan at the guess and at the matched pose.

    Args:
        reference: (K,) readings of the earlier scan [m], or the map.
        ranges: (K,) readings of the second scan [m].
        scanner: The scanner of both.
        guess: (3,) pose before the match [m, m, rad].
        pose: (3,) pose of the match.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> scanner = gs.Scanner([-0.5, 0.0, 0.5], range_max=9.0)
        >>> figure = gs.plots.match_figure(np.ones(3), np.ones(3), scanner, (0.2, 0, 0), (0, 0, 0))
        >>> [axes.get_title() for axes in figure.axes]
        ['before: 0.20 m, 0.00 m, 0.0 degrees', 'after: 0.00 m, 0.00 m, 0.0 degrees']
    """
    figure = new_figure(11.0, 5.5)
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    points = points_of(ranges, scanner)
    for ax, title, at in zip(axes, ("before", "after"), (guess, pose), strict=True):
        x, y, theta = np.asarray(at, np.float64)
        c, s = np.cos(theta), np.sin(theta)
        moved = points @ np.array([[c, s], [-s, c]]) + (x, y)
        if isinstance(reference, OccupancyGrid):
            draw_map(ax, reference)
        else:
            ax.plot(*points_of(reference, scanner).T, ".", color=OCCUPIED, ms=3, label="reference")
        ax.plot(*moved.T, ".", color=ESTIMATE, ms=2, label="second scan")
        ax.set(
            title=f"{title}: {x:z.2f} m, {y:z.2f} m, {np.degrees(theta):z.1f} degrees",
            xlabel="x [m]",
            ylabel="y [m]",
            aspect="equal",
        )
    near = np.concatenate([points @ np.array([[c, s], [-s, c]]) + (x, y), [(x, y)]])
    margin = 0.5
    axes[0].set(xlim=(near[:, 0].min() - margin, near[:, 0].max() + margin),
                ylim=(near[:, 1].min() - margin, near[:, 1].max() + margin))  # fmt: skip
    add_legend(axes[1])
    return figure


def points_of(ranges: ArrayLike, scanner: Scanner) -> np.ndarray:
    """Return the end points of the hits of a scan in the robot's frame."""
    z = np.asarray(masks.filled(ranges))
    hit = classify(z, scanner) == Reading.HIT
    points: np.ndarray = z[hit, None] * ray_vectors(scanner.bearings, scanner.mount)[hit] + np.array(scanner.mount[:2])
    return points
