"""Draw work-precision diagrams and performance profiles as Matplotlib figures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from gpusense.evaluation.benchmark.profiles import error_of, label, pareto_front, time_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Point = Mapping[str, Any]

MEASURES = {
    "ranges": (
        ("p99", "ranges", "p99", "99th percentile of the range error [cells]"),
        ("wrong", "ranges", "wrong_1", "share of rays wrong by more than one cell"),
    ),
    "beam": (
        ("kl", "comparable", "kl", "KL divergence of the posterior at a comparable temperature [nats]"),
        ("log-p", "log_p", "rms", "RMS error of the scan's log-likelihood [nats]"),
    ),
    "field": (
        ("kl", "comparable", "kl", "KL divergence of the posterior at a comparable temperature [nats]"),
        ("log-p", "log_p", "rms", "RMS error of the scan's log-likelihood [nats]"),
    ),
}
"""By problem: each diagram's short name, its error's kind and name, and its axis label."""

# Largest share of rays off by more than a cell for which an exact point is drawn in the strip of exact points.
_EXACT_ENOUGH = 1e-3
# Lower clamp of drawn errors, which are rounding below it.
_SMALLEST = 1e-9

# Okabe and Ito's palette first, which remains distinct under colour blindness.
_COLOURS = (
    "#000000", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f4f24", "#5e3c99", "#66a61e",
    "#a6761d", "#e7298a", "#8b0000", "#1b7f79", "#7a7a7a", "#b5651d", "#2f4f9f", "#c71585", "#556b2f", "#008b8b",
    "#9370db", "#cd5c5c", "#4682b4", "#daa520",
)  # fmt: skip
_MARKERS = "osD^vP*hX<>"
_STRIP, _FRONT = "#eef1f5", "#b8c0cc"
_LINES = {"float32": "-", "float64": ":"}


@dataclass(frozen=True)
class Style:
    """Style of the curves: a colour for each method, a marker for each device."""

    colours: Mapping[str, str]
    markers: Mapping[str, str]

    @classmethod
    def of(cls, points: Sequence[Point]) -> Style:
        """Make the style of a report's points, for all its diagrams."""
        methods = list(dict.fromkeys(map(label, points)))
        devices = list(dict.fromkeys(point["backend"] for point in points))
        return cls(
            {name: _COLOURS[i % len(_COLOURS)] for i, name in enumerate(methods)},
            {name: _MARKERS[i % len(_MARKERS)] for i, name in enumerate(devices)},
        )


def work_precision(points: Sequence[Point], style: Style, measure: Sequence[str], timing: str = "call") -> Figure:
    """Draw time over error, a panel for each scene, both axes logarithmic.

    Args:
        points: Points of one problem and one cloud.
        style: Colours and markers.
        measure: An element of ``MEASURES``.
        timing: ``"call"`` or ``"launch"``.
    """
    from gpusense.plots.drawing import new_figure

    _, kind, name, title = measure
    scenes = list(dict.fromkeys(point["scene"] for point in points))
    columns = min(len(scenes), 3)
    rows = -(-len(scenes) // columns)
    figure = new_figure(5.0 * max(columns, 2), 3.9 * rows + 1.6)
    axes = figure.subplots(rows, columns, squeeze=False)
    for ax, scene in zip(axes.flat, scenes, strict=False):
        _panel(ax, [point for point in points if point["scene"] == scene], style, kind, name, timing)
        ax.set_title(scene, loc="left")
    for ax in axes.flat[len(scenes) :]:
        ax.set_visible(False)
    unit = "ray" if points and points[0]["problem"] == "ranges" else "particle-beam"
    words = "call, arrays in and out" if timing == "call" else "launch alone"
    for i, ax in enumerate(axes.flat[: len(scenes)]):
        if i >= len(scenes) - columns:
            ax.set_xlabel(title)
        if i % columns == 0:
            ax.set_ylabel(f"time per {unit} [ns]\n{words}")
    _legend(figure, style, points, front=True)
    return figure


def place(point: Point, kind: str, name: str) -> float | None:
    """Return a point's position on the axis of errors; 0 for the strip of exact points, None for failed points."""
    error = error_of(point, kind, name)
    if error is None:
        return None
    wrong = error_of(point, "ranges", "wrong_1") or 0.0
    if point["exact"] and wrong <= _EXACT_ENOUGH:
        return 0.0
    return 0.0 if error == 0 else max(error, _SMALLEST)


def _panel(ax: Axes, points: Sequence[Point], style: Style, kind: str, name: str, timing: str) -> None:
    placed = [(place(point, kind, name), _nanoseconds(point, timing), point) for point in points]
    errors = [error for error, y, _ in placed if error and y]
    low = 10.0 ** math.floor(math.log10(min(errors, default=1e-2)))
    high = 10.0 ** math.ceil(math.log10(max(errors, default=1.0) * 1.001))
    # Strips for exact and failed points; the width of each is 14 % of the decades in between.
    width = (high / low) ** 0.14
    left, right = low / width**0.5, high * width**0.5
    ax.set(xscale="log", yscale="log", xlim=(low / width, high * width))
    ax.axvspan(low / width, low, color=_STRIP, zorder=0)
    ax.axvspan(high, high * width, color=_STRIP, zorder=0)
    for x, text in ((left, "exact"), (right, "failed")):
        ax.text(x, 0.01, text, transform=ax.get_xaxis_transform(), ha="center", va="bottom", fontsize="x-small",
                color="#4a5568")  # fmt: skip
    seen = [(left if error == 0 else error, y) for error, y, _ in placed if error is not None and y]
    _draw_front(ax, seen, high)
    curves: dict[tuple[str, ...], list[tuple[float, float, Point]]] = {}
    unplaced = 0
    for error, y, point in placed:
        colour, marker = style.colours[label(point)], style.markers[point["backend"]]
        if error is not None and y:
            key = (label(point), point["backend"], point["precision"])
            curves.setdefault(key, []).append((left if error == 0 else error, y, point))
        elif point["status"] != "left out":
            # A failed point without a time is listed from the top of the strip downwards.
            height = y if y else 0.96 - 0.045 * unplaced
            unplaced += not y
            ax.plot([right], [height], "x", color=colour, ms=7, mew=1.6,
                    transform=ax.transData if y else ax.get_xaxis_transform(), clip_on=False)  # fmt: skip
            ax.plot([right], [height], marker, color=colour, ms=4, mfc="none", mew=0.6,
                    transform=ax.transData if y else ax.get_xaxis_transform(), clip_on=False)  # fmt: skip
    for (method, backend, precision), curve in curves.items():
        curve.sort(key=lambda item: item[2]["value"] or 0)
        ax.plot([x for x, _, _ in curve], [y for _, y, _ in curve], _LINES[precision], color=style.colours[method],
                marker=style.markers[backend], ms=5, lw=1.1, mew=0.7,
                mfc="none" if precision == "float64" else style.colours[method], alpha=0.9, zorder=3)  # fmt: skip
    ax.grid(True, which="major", color="#e3e7ed", lw=0.6, zorder=1)
    _label_times(ax)


def _label_times(ax: Axes) -> None:
    """Label the axis of times with plain numbers at 1, 2 and 5 of each decade."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=30))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.yaxis.set_minor_formatter(NullFormatter())


def _draw_front(ax: Axes, seen: Sequence[tuple[float, float]], high: float) -> None:
    """Draw the Pareto front as stairs: the points that no other point dominates in error and time."""
    front = [seen[i] for i in pareto_front(seen)]
    if front:
        ax.step([x for x, _ in front] + [high], [y for _, y in front] + [front[-1][1]], where="post", color=_FRONT,
                lw=4.0, alpha=0.8, solid_capstyle="round", zorder=2)  # fmt: skip


def _nanoseconds(point: Point, timing: str) -> float | None:
    seconds = time_of(point, timing)
    return None if seconds is None or not point["work"] else 1e9 * seconds / point["work"]


def _legend(figure: Figure, style: Style, points: Sequence[Point], *, front: bool) -> None:
    from matplotlib.lines import Line2D

    methods, devices = ({key(point) for point in points} for key in (label, lambda point: point["backend"]))
    handles = [Line2D([], [], color=c, lw=2, label=name) for name, c in style.colours.items() if name in methods]
    handles += [
        Line2D([], [], color="#4a5568", marker=marker, ls="", ms=6, label=name)
        for name, marker in style.markers.items() if name in devices
    ]  # fmt: skip
    for precision in dict.fromkeys(point["precision"] for point in points):
        handles.append(Line2D([], [], color="#4a5568", ls=_LINES[precision], label=precision))
    if front:
        handles.append(Line2D([], [], color=_FRONT, lw=4, label="Pareto front"))
    if front and any(point["status"] in ("failed", "unstable") for point in points):
        handles.append(Line2D([], [], color="#4a5568", marker="x", ls="", ms=7, mew=1.6, label="failed or unstable"))
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize="small", frameon=False)


def profile_figure(profiles: Sequence[Mapping[str, Any]], points: Sequence[Point], style: Style) -> Figure:
    """Draw performance profiles, a panel for each problem and kind of device.

    Args:
        profiles: Profiles of :func:`gpusense.evaluation.benchmark.profiles.profiles_of`.
        points: The report's points.
        style: Colours and markers.
    """
    from gpusense.plots.drawing import new_figure

    figure = new_figure(10.0, 4.2 * len(profiles) + 1.2)
    for ax, profile in zip(figure.subplots(len(profiles), 1, squeeze=False).flat, profiles, strict=True):
        widest = max((step[0] for curve in profile["curves"] for step in curve["steps"]), default=1.0)
        last = max(1.5 * widest, 10.0)
        for curve in profile["curves"]:
            steps = [(1.0, 0.0), *curve["steps"], (last, curve["steps"][-1][1])]
            colour, xs, ys = style.colours[curve["method"]], [x for x, _ in steps], [y for _, y in steps]
            ax.step(xs, ys, _LINES[curve["precision"]], where="post", color=colour, lw=1.3, alpha=0.9)
            ax.plot(xs[1:-1], ys[1:-1], style.markers[curve["backend"]], color=colour, ms=4, alpha=0.9)
        ax.set(xscale="log", xlim=(0.95, last), ylim=(-0.03, 1.05), ylabel="share of problems solved",
               xlabel="time as a multiple of the fastest")  # fmt: skip
        ax.set_title(
            f"{profile['problem']} on a {profile['kind']}: {profile['limit']}; {len(profile['problems'])} problems",
            loc="left", fontsize="medium",
        )  # fmt: skip
        ax.grid(True, color="#e3e7ed", lw=0.6)
    drawn = {(c["method"], c["backend"], c["precision"]) for p in profiles for c in p["curves"]}
    _legend(figure, style, [p for p in points if (label(p), p["backend"], p["precision"]) in drawn], front=False)
    return figure
