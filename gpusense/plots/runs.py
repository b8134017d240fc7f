"""Draw results along a log: the scores of its scans, and the track of a filter."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gpusense.evaluation.scoring import LogScore
from gpusense.evaluation.tracking import Track
from gpusense.localization.filter import ParticleFilter
from gpusense.plots.drawing import CLOUD, ESTIMATE, REFERENCE, VERDICTS, add_legend, draw_map, new_figure
from gpusense.world.grid import OccupancyGrid

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def scores_figure(grid: OccupancyGrid, score: LogScore, pose: str = "logged pose") -> Figure:
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


def track_figure(pf: ParticleFilter, track: Track) -> Figure:
    """Draw the map with estimated and reference poses and the last particles, and errors along the track."""
    figure = new_figure(11.0, 6.0)
    axes = figure.subplot_mosaic([["map", "error"], ["map", "explained"]], width_ratios=(1.6, 1.0))
    ax, upper, lower = (axes[name] for name in ("map", "error", "explained"))
    draw_map(ax, pf.grid)
    poses, references = np.array(track.poses).reshape(-1, 3), track.references
    if references is not None:
        # A line cannot show single known poses.
        style = "-" if np.isfinite(references).all() else "."
        ax.plot(references[:, 0], references[:, 1], style, color=REFERENCE, lw=1.6, label="reference pose")
    # Before convergence the mean of particles that lie apart is no pose of the robot.
    first = len(poses) if track.converged is None else track.converged
    if first:
        ax.plot(*poses[: first + 1, :2].T, ":", color=ESTIMATE, lw=0.8, alpha=0.4, label="mean before convergence")
    ax.plot(*poses[first:, :2].T, "-", color=ESTIMATE, lw=1.2, label="estimate")
    cloud = pf.host_particles()
    ax.plot(cloud[:, 0], cloud[:, 1], ".", color=CLOUD, ms=1.5, label="particles after the last scan")
    ax.plot(*poses[-1, :2], "o", color=ESTIMATE, ms=5, label="last pose")
    add_legend(ax, 3)
    verdict = track.verdicts[-1]
    ax.set_title(f"{verdict.upper()} (p_lost {track.p_lost[-1]:.2g})", color=VERDICTS[verdict], loc="left")
    deviation = np.sqrt([max(c[0, 0] + c[1, 1], 0.0) for c in track.covariances])
    index = [step.index for step in track.steps]
    errors = track.errors()
    if errors is not None:
        known = np.isfinite(errors[0])
        upper.semilogy(
            np.array(index)[known], np.maximum(errors[0][known], 1e-4), color=ESTIMATE, lw=0.8, label="error"
        )
    upper.semilogy(index, np.maximum(deviation, 1e-4), color=CLOUD, lw=0.8, label="deviation of the particles")
    upper.set(xlabel="scan", ylabel="position [m]")
    add_legend(upper, 2)
    lower.plot(index, track.explained, color=CLOUD, lw=0.8, label="share of beams explained")
    lower.plot(index, track.p_lost, color=ESTIMATE, lw=0.8, label="p_lost")
    lower.set(xlabel="scan", ylim=(0, 1.02))
    add_legend(lower, 2)
    return figure
