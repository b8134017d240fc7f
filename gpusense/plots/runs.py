"""Draw results along a log: scores of scans, the track of a filter, chains, matches, judgements; and tables of jobs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from gpusense.plots.drawing import (
    CLOSED,
    CLOUD,
    ESTIMATE,
    FRAME,
    OCCUPIED,
    REFERENCE,
    SCALE,
    VERDICTS,
    add_colour_bar,
    add_legend,
    draw_ellipse,
    draw_map,
    end_points,
    new_figure,
)
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Scanner

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from gpusense.chaining.result import ScanChain
    from gpusense.evaluation.integrity import Integrity
    from gpusense.evaluation.judging import Judgement
    from gpusense.evaluation.scoring import LogScore
    from gpusense.evaluation.tracking import Track
    from gpusense.localization.filter import ParticleFilter


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


PATH, DOUBTED, KEY = CLOUD, ESTIMATE, "#1f3552"
# Number of ellipses.
_ELLIPSES = 40


def chain_figure(grid: OccupancyGrid, chain: ScanChain) -> Figure:
    """Draw the map and the trajectory with closures, doubtful stretches and ellipses of one deviation."""
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
        draw_ellipse(ax, poses[k, :2], chain.covariance[k, :2, :2], 1.0, color=PATH, lw=0.5, alpha=0.7, label=label)
    ax.set(xlabel="x [m]", ylabel="y [m]")
    doubts = f"DOUBTFUL in {len(chain.doubts)} places" if chain.doubts else "CONSISTENT"
    ax.set_title(f"{doubts}: {len(poses)} scans, {len(chain.corrections)} closures", loc="left")
    add_legend(ax, 5)
    return figure


def match_figure(
    reference: ArrayLike | OccupancyGrid, ranges: ArrayLike, scanner: Scanner, guess: ArrayLike, pose: ArrayLike
) -> Figure:
    """Draw the (K,) reference readings or the map, and the second scan at the guess and at the matched (3,) pose."""
    figure = new_figure(11.0, 5.5)
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    for ax, title, at in zip(axes, ("before", "after"), (guess, pose), strict=True):
        x, y, theta = np.asarray(at, np.float64)
        moved = end_points(ranges, scanner, at)
        if isinstance(reference, OccupancyGrid):
            draw_map(ax, reference)
        else:
            ax.plot(*end_points(reference, scanner).T, ".", color=OCCUPIED, ms=3, label="reference")
        ax.plot(*moved.T, ".", color=ESTIMATE, ms=2, label="second scan")
        ax.set(
            title=f"{title}: {x:z.2f} m, {y:z.2f} m, {np.degrees(theta):z.1f} degrees",
            xlabel="x [m]",
            ylabel="y [m]",
            aspect="equal",
        )
    near = np.concatenate([moved, [(x, y)]])
    margin = 0.5
    axes[0].set(xlim=(near[:, 0].min() - margin, near[:, 0].max() + margin),
                ylim=(near[:, 1].min() - margin, near[:, 1].max() + margin))  # fmt: skip
    add_legend(axes[1])
    return figure


_COLOURS = ("#4c78a8", "#e4572e", "#54a24b", "#b279a2", "#f2a541", "#72b7b2", "#9d755d", "#ff9da6")
_MARKERS = "osD^vP*X<>"
_LABELS = {
    "error_median": "median error of position [m]", "error_position_median": "median error of the mean [m]",
    "per_reading": "log-likelihood of a reading [nats]",
}  # fmt: skip


def sweep_figure(columns: Mapping[str, Sequence[Any]]) -> Figure:
    """Draw the jobs of a table; models have colours, values of a second axis have shapes."""
    from gpusense.sweeps.tasks import TASKS

    tasks = [TASKS[task].error for task in dict.fromkeys(columns.get("task", ())) if task in TASKS]
    error = next((name for name in tasks if name in columns), None)
    if error is None:
        raise ValueError("table: must have jobs with an error to draw, got none")
    name, unit = ("ms_step", "time of a step [ms]") if "ms_step" in columns else ("seconds", "time of a job [s]")
    time, values = (np.array([np.nan if one is None else one for one in columns[key]], float) for key in (name, error))
    drawn = np.isfinite(time) & np.isfinite(values)
    if not drawn.any():
        raise ValueError("table: must have jobs with an error to draw, got none")
    colour, shape = _axes(columns)
    figure = new_figure(8.5, 5.5)
    ax = figure.subplots()
    colours, shapes = _places(columns, colour), _places(columns, shape)
    for pair in dict.fromkeys(zip(colours, shapes, strict=True)):
        chosen = drawn & np.array([one == pair for one in zip(colours, shapes, strict=True)])
        text = ", ".join(dict.fromkeys(str(one) for one in pair if one is not None))
        style = dict(
            color=_COLOURS[list(dict.fromkeys(colours)).index(pair[0]) % len(_COLOURS)],
            marker=_MARKERS[list(dict.fromkeys(shapes)).index(pair[1]) % len(_MARKERS)],
        )
        ax.plot(time[chosen], values[chosen], ls="", ms=4, alpha=0.6, label=text, **style)  # type: ignore[arg-type]
    ax.set(xscale="log", xlabel=unit, ylabel=_LABELS.get(error, error))
    if (values[drawn] > 0).all():
        ax.set_yscale("log")
    failed = sum(status == "failed" for status in columns["status"])
    ax.set_title(f"{int(drawn.sum())} jobs" + (f", {failed} failed" if failed else ""), loc="left")
    ax.grid(alpha=0.3)
    ax.legend(fontsize="small", title=" and ".join(one for one in (colour, shape) if one), title_fontsize="small")
    return figure


def _axes(columns: Mapping[str, Sequence[Any]]) -> tuple[str, str]:
    """Return the columns for colours and shapes: models, labelled axes, particles, or ""."""
    labelled = {name: 1 for name in columns if name.startswith("axis.")}
    candidates = {"model": 0, **labelled, "axis.log": 2, "particles": 3}
    varied = {name: len(set(columns[name])) for name in candidates if name in columns}
    chosen = sorted((rank, name) for name, rank in candidates.items() if 1 < varied.get(name, 0) <= len(_MARKERS))
    names = [name for _, name in chosen] + ["", ""]
    return names[0], names[1]


def _places(columns: Mapping[str, Sequence[Any]], name: str) -> list[Any]:
    return list(columns[name]) if name else [None] * len(columns["key"])


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
