"""Draw a recorded run among landmarks: logged path, estimate and landmarks, and the error over time."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gpusense.evaluation.landmark_runs import Track
from gpusense.learning.landmark.suspicious import Suspicions
from gpusense.logs.records import LandmarkRun
from gpusense.plots.drawing import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LOGGED, ESTIMATE, SUSPICIOUS = "#8fa3b8", "#e4572e", "#b8860b"


def run_figure(run: LandmarkRun, track: Track, suspicions: Suspicions) -> Figure:
    """Draw logged path, estimate and landmarks, with suspicious ones marked, and the error over time.

    Args:
        run: The run.
        track: The filter's result.
        suspicions: Landmarks whose positions are exchanged or wrong.
    """
    figure = new_figure(11.0, 6.0)
    axes = figure.subplot_mosaic([["map", "error"], ["map", "heading"]], width_ratios=(1.4, 1.0))
    ax, xy = axes["map"], run.landmarks.xy
    ax.plot(run.truth[:, 0], run.truth[:, 1], color=LOGGED, lw=1.0, label="logged path")
    ax.plot(track.estimate[:, 0], track.estimate[:, 1], color=ESTIMATE, lw=0.7, label="estimate")
    ax.plot(xy[:, 0], xy[:, 1], "k^", ms=5, label="landmarks")
    exchanged = {index for pair in suspicions.exchanged for index in (pair.first, pair.second)}
    marked = sorted(exchanged | {each.landmark for each in suspicions.misplaced})
    if marked:
        ax.plot(xy[marked, 0], xy[marked, 1], "o", ms=13, mfc="none", mec=SUSPICIOUS, mew=1.8, label="suspicious")
    for label, (x, y) in zip(run.labels, xy, strict=True):
        ax.annotate(str(label), (x, y), xytext=(5, 4), textcoords="offset points", fontsize="small")
    ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    ax.legend(loc="best", fontsize="small")
    for name, values, quantity in (
        ("error", track.error, "position [m]"),
        ("heading", track.error_heading, "heading [rad]"),
    ):
        axes[name].plot(run.time, values, color=ESTIMATE, lw=0.6)
        axes[name].set(xlabel="time [s]", ylabel=f"error of the {quantity}")
    return figure
