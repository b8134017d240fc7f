"""Draw a chain of scans: map, trajectory, loop closures and doubtful stretches."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gpusense.chaining.result import ScanChain
from gpusense.plots.drawing import CLOSED, CLOUD, ESTIMATE, add_legend, draw_map, new_figure
from gpusense.world.grid import OccupancyGrid

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PATH, DOUBTED, KEY = CLOUD, ESTIMATE, "#1f3552"
# Number of ellipses.
_ELLIPSES = 40


def chain_figure(grid: OccupancyGrid, chain: ScanChain) -> Figure:
    """Draw the map and the trajectory with closures, doubtful stretches and ellipses of one deviation.

    Args:
        grid: The map of the scans.
        chain: The chain.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> scanner = gs.Scanner([-0.5, 0.0, 0.5], range_max=9.0)
        >>> chain = gs.chain_scans(np.ones((2, 3)), scanner, backend="numpy")
        >>> figure = gs.plots.chain_figure(gs.OccupancyGrid([[0]], 1.0), chain)
        >>> figure.axes[0].get_xlabel()
        'x [m]'
    """
    from matplotlib.collections import LineCollection

    figure = new_figure(9.0, 8.0)
    ax = figure.add_subplot()
    draw_map(ax, grid)
    poses, closures = chain.poses, chain.closures
    ax.plot(poses[:, 0], poses[:, 1], "-", color=PATH, lw=0.9, label="trajectory")
    ax.plot(*poses[chain.keys, :2].T, ".", color=KEY, ms=2, label="key scans")
    if len(closures):
        ends = np.stack([poses[closures.first, :2], poses[closures.second, :2]], axis=1)
        ax.add_collection(LineCollection(list(ends), colors=CLOSED, linewidths=0.7, label="closures"))
    for number, doubt in enumerate(chain.doubts):
        part = poses[doubt.first : doubt.last + 1]
        ax.plot(part[:, 0], part[:, 1], "-", color=DOUBTED, lw=2.2, label="" if number else "doubtful")
    for number, k in enumerate(chain.keys[:: max(len(chain.keys) // _ELLIPSES, 1)]):
        label = "" if number else "one deviation, from the first pose"
        _ellipse(ax, poses[k], chain.covariance[k, :2, :2], float(np.ptp(poses[:, :2], axis=0).max()), label)
    ax.set(xlabel="x [m]", ylabel="y [m]")
    doubts = f"DOUBTFUL in {len(chain.doubts)} places" if chain.doubts else "CONSISTENT"
    ax.set_title(f"{doubts}: {len(poses)} scans, {len(chain.corrections)} closures", loc="left")
    add_legend(ax, 5)
    return figure


def _ellipse(ax: object, pose: np.ndarray, covariance: np.ndarray, largest: float, label: str) -> None:
    """Draw an ellipse of one deviation, no larger than the trajectory."""
    values, vectors = np.linalg.eigh(covariance)
    axes = np.minimum(np.sqrt(np.maximum(values, 0.0)), max(largest, 1e-3))
    t = np.linspace(0, 2 * np.pi, 37)
    x, y = pose[:2, None] + vectors @ (axes[:, None] * np.stack([np.cos(t), np.sin(t)]))
    ax.plot(x, y, "-", color=PATH, lw=0.5, alpha=0.7, label=label)  # type: ignore[attr-defined]
