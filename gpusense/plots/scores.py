"""Draw the scores of a log: logged and estimated poses on the map, and histograms of percentiles and errors."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gpusense.evaluation.scoring import BackendScore
from gpusense.plots.drawing import CLOUD, ESTIMATE, REFERENCE, add_legend, draw_map, new_figure
from gpusense.world.grid import OccupancyGrid

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def scores_figure(grid: OccupancyGrid, score: BackendScore, pose: str = "logged pose") -> Figure:
    """Draw the map with poses of the scans and weighted means, and histograms of percentiles and errors."""
    figure = new_figure(11.0, 6.0)
    axes = figure.subplot_mosaic([["map", "percentile"], ["map", "error"]], width_ratios=(1.6, 1.0))
    ax, upper, lower = (axes[name] for name in ("map", "percentile", "error"))
    draw_map(ax, grid)
    poses = [scan.pose for scan in score.scans]
    ax.plot([p[0] for p in poses], [p[1] for p in poses], ".-", color=REFERENCE, lw=0.6, ms=3, label=pose)
    pairs = [(scan.pose, scan.mean) for scan in score.scans if scan.mean is not None]
    for true, mean in pairs:
        ax.plot([true[0], mean[0]], [true[1], mean[1]], color=ESTIMATE, lw=0.8)
    means = [mean for _, mean in pairs]
    ax.plot([p[0] for p in means], [p[1] for p in means], "o", color=ESTIMATE, ms=3, mew=0, label="weighted mean")
    add_legend(ax)
    upper.hist([scan.percentile for scan in score.scans], bins=30, color=CLOUD)
    upper.set(xlabel=f"percentile of the {pose}", ylabel="scans")
    errors = [scan.error_position for scan in score.scans if scan.error_position is not None]
    top = max(errors, default=0.0) or 1.0
    low = max(min(errors, default=1e-3), 1e-3, top * 1e-6)
    bins = [low * (top / low) ** (i / 30) for i in range(31)] if low < top else 30
    lower.hist(errors, bins=bins, color=ESTIMATE)
    lower.set(xscale="log", xlabel="error of the weighted mean [m]", ylabel="scans")
    return figure
