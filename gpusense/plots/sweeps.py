"""Draw a sweep: error against run time, one point per job."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from gpusense.plots.drawing import new_figure
from gpusense.sweeps.tasks import TASKS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLOURS = ("#4c78a8", "#e4572e", "#54a24b", "#b279a2", "#f2a541", "#72b7b2", "#9d755d", "#ff9da6")
_MARKERS = "osD^vP*X<>"
_LABELS = {
    "error_median": "median error of position [m]", "error_position_median": "median error of the mean [m]",
    "per_reading": "log-likelihood of a reading [nats]",
}  # fmt: skip


def sweep_figure(columns: Mapping[str, Sequence[Any]]) -> Figure:
    """Draw the jobs of a table; models have colours, values of a second axis have shapes."""
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
