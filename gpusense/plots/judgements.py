"""Draw a judgement: the track coloured by p_lost, p_lost and radius over time, and the Stanford diagram."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from gpusense.plots.drawing import (
    CLOUD,
    ESTIMATE,
    FRAME,
    SCALE,
    VERDICTS,
    add_colour_bar,
    add_legend,
    draw_map,
    new_figure,
)
from gpusense.world.grid import OccupancyGrid

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from gpusense.evaluation.integrity import Integrity
    from gpusense.evaluation.judging import Judgement

# Space around the track, relative to its size, and at least [m].
_MARGIN, _LEAST = 0.15, 3.0
# Radii beyond are drawn at this multiple of the alert limit or of the largest finite radius.
_BEYOND = 1.6


def judgement_figure(
    grid: OccupancyGrid, found: Judgement, rated: Integrity | None = None, errors: np.ndarray | None = None
) -> Figure:
    """Draw the track on the map coloured by p_lost, likelier places of lost poses, and p_lost and radius over time.

    ``rated``: Integrity by a truth, for the Stanford diagram. ``errors``: (N,) errors of the poses, NaN where unknown
    [m].
    """
    rows: Any = [["map", "p_lost"], ["map", "radius"]]
    if rated is not None:
        rows.append(["map", "stanford"])
    figure = new_figure(12.0, 3.0 * len(rows) + 0.5)
    axes = figure.subplot_mosaic(rows, width_ratios=(1.6, 1.0))
    _draw_track(axes["map"], grid, found)
    axes["map"].set_title(
        f"LOST for {found.duration('lost'):.1f} of {found.duration():.1f} s" if found.lost else "RIGHT",
        color=VERDICTS["lost" if found.lost else "tracking"],
        loc="left",
    )
    time = found.times - found.times[0]
    ax = axes["p_lost"]
    ax.plot(time, found.explained, color=CLOUD, lw=0.8, label="share of beams explained")
    ax.plot(time, found.p_lost, color=ESTIMATE, lw=1.2, label="p_lost")
    ax.set(xlabel="time [s]", ylim=(0, 1.02))
    add_legend(ax, 2)
    _draw_radius(axes["radius"], time, found, rated, errors)
    if rated is not None:
        draw_stanford(axes["stanford"], rated)
    return figure


def _draw_track(ax: Axes, grid: OccupancyGrid, found: Judgement) -> None:
    draw_map(ax, grid)
    x, y = found.poses[:, 0], found.poses[:, 1]
    ax.plot(x, y, "-", color=FRAME, lw=0.6, zorder=3)
    from matplotlib.colors import LinearSegmentedColormap

    colours = LinearSegmentedColormap.from_list("p_lost", SCALE[1:])
    order = np.argsort(found.p_lost, kind="stable")
    dots = ax.scatter(
        x[order], y[order], c=found.p_lost[order], cmap=colours, s=8, vmin=0, vmax=1, linewidths=0, zorder=4
    )
    add_colour_bar(ax, dots, "p_lost")
    places = []
    for one in found.stretches:
        if one.place is not None and math.isfinite(one.off):
            places.append(one.place.pose)
            ax.plot(*np.array([one.pose[:2], one.place.pose[:2]]).T, ":", color=ESTIMATE, lw=1.0, zorder=5)
            ax.plot(*one.place.pose[:2], "x", color=ESTIMATE, ms=8, mew=2, zorder=6)
    if places:
        ax.plot([], [], "x", color=ESTIMATE, ms=8, mew=2, label="likeliest place of a lost stretch")
        add_legend(ax, 2)
    shown = np.vstack([found.poses[:, :2], *(place[None, :2] for place in places)])
    low, high = shown.min(axis=0), shown.max(axis=0)
    space = max(_MARGIN * float((high - low).max()), _LEAST)
    x_min, y_min, x_max, y_max = grid.bounds()
    ax.set(
        xlim=(max(low[0] - space, min(x_min, low[0])), min(high[0] + space, max(x_max, high[0]))),
        ylim=(max(low[1] - space, min(y_min, low[1])), min(high[1] + space, max(y_max, high[1]))),
    )


def _draw_radius(
    ax: Axes, time: np.ndarray, found: Judgement, rated: Integrity | None, errors: np.ndarray | None
) -> None:
    """Draw the radius over time; infinite ones as a band at the top."""
    finite = np.isfinite(found.radii)
    limit = 1.0 if rated is None else rated.alert_limit
    top = _BEYOND * max(limit, float(found.radii[finite].max(initial=0.0)))
    ax.plot(time, np.where(finite, found.radii, np.nan), color=CLOUD, lw=1.2, label=f"radius, risk {found.risk:g}")
    ax.fill_between(time, 0, 1, where=~finite, step="post", color=ESTIMATE, alpha=0.25, linewidth=0,
                    transform=ax.get_xaxis_transform(), label="no radius can be promised")  # fmt: skip
    if errors is not None and np.isfinite(errors).any():
        ax.plot(time, np.minimum(errors, top), ".", color=ESTIMATE, ms=3, label="error")
    if rated is not None:
        ax.axhline(limit, color=FRAME, lw=1.0, ls="--", label="alert limit")
    ax.set(xlabel="time [s]", ylabel="[m]", ylim=(0, top))
    add_legend(ax, 2)


def draw_stanford(ax: Axes, rated: Integrity) -> None:
    """Draw the Stanford diagram: the radius of each pose against its error, and the share of each class."""
    limit = rated.alert_limit
    top = 2 * limit
    error, radius = np.minimum(rated.errors, 0.99 * top), np.minimum(rated.radii, 0.99 * top)
    ax.fill([limit, top, top, limit], [0, 0, limit, limit], color=ESTIMATE, alpha=0.30, linewidth=0)
    ax.fill([0, limit, limit], [0, 0, limit], color=SCALE[1], alpha=0.45, linewidth=0)
    ax.fill([0, top, top, 0], [limit, limit, top, top], color=FRAME, alpha=0.25, linewidth=0)
    ax.plot([0, top], [0, top], color=FRAME, lw=0.8)
    ax.plot(error, radius, ".", color=CLOUD, ms=3, alpha=0.6, rasterized=True)
    style: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": "small"}
    ax.text(1.5 * limit, 0.5 * limit, f"hazardously\nmisleading\n{100 * rated.hazardous:.3g} %", **style)
    ax.text(0.72 * limit, 0.22 * limit, f"misleading\n{100 * rated.misleading:.3g} %", **style)
    ax.text(0.5 * limit, 1.6 * limit, f"unavailable\n{100 * (1 - rated.available):.3g} %", **style)
    ax.set(xlim=(0, top), ylim=(0, top), xlabel="error [m]", ylabel="radius [m]")
