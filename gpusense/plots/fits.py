"""Draw a fit: readings, density over their histogram, trace of the log-likelihood, surface of the density.

Book figures 6.5 and 6.6. Matplotlib is imported on first use; see :mod:`gpusense.plots.drawing`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gpusense.plots.drawing import BEAM, FRAME, ROBOT, colours, new_figure
from gpusense.world.parameters import BeamParameters
from gpusense.world.range_causes import NoReturn, RandomDensity
from gpusense.world.scanner import Reading

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from gpusense.evaluation.range_data import RangeData
    from gpusense.learning.beam.incidence import IncidenceFit

# Cells of the histograms over (z, z*) and over z.
_CELLS, _BARS = 200, 80
# Largest number of drawn readings; more are thinned.
_DRAWN = 10_000


def distances_of(data: RangeData, count: int = 3) -> list[float]:
    """Choose distinct expected ranges [m] with many readings, as quantiles of all expected ranges."""
    known = data.expected[(data.kinds != Reading.MISSING) & (data.expected < data.range_max)]
    if not len(known):
        return []
    return sorted({float(value) for value in np.quantile(known, (np.arange(count) + 0.5) / count)})


def readings_figure(data: RangeData, distances: list[float]) -> Figure:
    """Draw readings against expected ranges, and raw readings around some distances [m] (book figure 6.5)."""
    from matplotlib.colors import LogNorm

    figure = new_figure(12.0, 5.0)
    left, right = figure.subplots(1, 2)
    top = _top(data)
    known = data.kinds == Reading.HIT
    edges = np.linspace(0, top, _CELLS + 1)
    counts, _, _ = np.histogram2d(data.expected[known], data.ranges[known], bins=(edges, edges))
    image = left.imshow(
        np.ma.masked_equal(counts.T, 0), origin="lower", extent=(0, top, 0, top), aspect="auto", cmap=colours(),
        norm=LogNorm(vmin=1, vmax=max(counts.max(), 2)),
    )  # fmt: skip
    figure.colorbar(image, ax=left, label="readings")
    left.plot([0, top], [0, top], color=ROBOT, lw=0.6)
    none = int(np.count_nonzero(data.kinds == Reading.MAX))
    left.set(
        xlabel="expected range z* [m]", ylabel="reading z [m]", title=f"{known.sum()} ranges, {none} without return"
    )
    edge = min(data.range_max, 2.5 * max(distances, default=data.range_max))
    for place, distance in enumerate(distances):
        near, width = _near(data, distance)
        # Draw readings beyond the axis, and readings without return, on its upper edge.
        z = np.minimum(np.where(data.kinds == Reading.MAX, edge, data.ranges)[near], edge)
        z = z[:: max(-(-len(z) // _DRAWN), 1)]
        right.plot(
            np.linspace(0, 1, len(z)), z, ".", ms=1.5, color=f"C{place}", label=f"{distance:.2f} +- {width:.2f} m"
        )
        right.axhline(distance, color=f"C{place}", lw=0.6)
    right.set(xlabel="place in the data", ylabel="reading z [m]", title="Raw readings where z* is", ylim=(0, edge))
    if distances:
        right.legend(loc="upper right", fontsize="small", markerscale=6)
    return figure


def density_figure(data: RangeData, parameters: BeamParameters, distances: list[float]) -> Figure:
    """Draw histograms of readings around some distances [m], with the fitted density (book figure 6.6)."""
    figure = new_figure(5.0 * max(len(distances), 1), 4.2)
    axes = figure.subplots(1, max(len(distances), 1), squeeze=False)[0]
    for ax, distance in zip(axes, distances, strict=False):
        _density_panel(ax, data, parameters, distance)
    axes[0].set_ylabel("density [1/m]")
    return figure


def _density_panel(ax: Axes, data: RangeData, parameters: BeamParameters, distance: float) -> None:
    """Draw the histogram of the readings around one expected range, with the fitted density."""
    from gpusense.models.scan.densities import log_mixture

    near, width = _near(data, distance)
    hit = near & (data.kinds == Reading.HIT)
    total, none = int(near.sum()), int((near & (data.kinds == Reading.MAX)).sum())
    top = min(data.range_max, 2.5 * distance + 1)
    edges = np.linspace(0, top, _BARS + 1)
    counts, _ = np.histogram(data.ranges[hit], edges)
    wide = edges[1] - edges[0]
    ax.stairs(counts / (max(total, 1) * wide), edges, fill=True, color=FRAME, label=f"{total} readings")
    z = np.unique(np.concatenate([np.linspace(0, top * (1 - 1e-9), 800), distance + np.linspace(-0.5, 0.5, 201)]))
    z = z[(z >= 0) & (z < min(top, data.range_max))]
    # The curve is the mean density over the expected ranges of these readings.
    expected = _spaced(data.expected[near], 60)
    log_p = log_mixture(z, expected[:, None], range_max=data.range_max, **parameters.to_dict())
    ax.plot(
        z,
        np.exp(log_p).mean(axis=0) if len(expected) else np.zeros_like(z),
        color=ROBOT,
        lw=1.2,
        label="fitted p(z | z*)",
    )
    lowest = min(0.3 / (max(total, 1) * wide), 0.5 * RandomDensity(data.range_max).peak(parameters.z_rand) or math.inf)
    ax.set(yscale="log", ylim=(max(lowest, 1e-6), None), xlabel="reading z [m]",
           title=f"z* = {distance:.2f} +- {width:.2f} m; no return: {none / max(total, 1):.3f}, "
           f"fitted {parameters.z_max:.3f}")  # fmt: skip
    ax.title.set_fontsize("medium")
    ax.legend(loc="upper right", fontsize="small")


def trace_figure(trace: NDArray[np.float64], method: str) -> Figure:
    """Draw (I,) log-likelihoods [nats] after each iteration, and their distances from the highest one."""
    figure = new_figure(10.0, 3.8)
    left, right = figure.subplots(1, 2)
    iteration = np.arange(len(trace))
    left.plot(iteration, trace, ".-", color=BEAM)
    left.set(xlabel="iteration", ylabel="log-likelihood [nats]", title=f"method {method}")
    left.ticklabel_format(axis="y", useOffset=False)
    rest = trace.max() - trace
    right.semilogy(iteration[rest > 0], rest[rest > 0], ".-", color=ROBOT)
    right.set(xlabel="iteration", ylabel="below the highest [nats]", title="remaining gain")
    return figure


def surface_figure(data: RangeData, parameters: BeamParameters) -> Figure:
    """Draw log p(z | z*) over readings and expected ranges; the title states log p of no return."""
    from gpusense.models.scan.densities import log_mixture

    figure = new_figure(6.6, 5.2)
    ax = figure.subplots()
    top = _top(data)
    middle = (np.arange(400) + 0.5) * top / 400
    log_p = log_mixture(middle[:, None], middle, range_max=data.range_max, **parameters.to_dict())
    finite = log_p[np.isfinite(log_p)]
    low = float(finite.min()) if len(finite) else -1.0
    # The scale ends at the median of readings away from the ridge, so that other causes are visible.
    low = max(low, float(np.quantile(finite, 0.02)), float(finite.max()) - 12) if len(finite) else low
    image = ax.imshow(np.maximum(log_p, low), origin="lower", extent=(0, top, 0, top), aspect="auto", cmap=colours())
    figure.colorbar(image, ax=ax, label="log p(z | z*) [log 1/m]", extend="min")
    none = f"log z_max = {NoReturn(parameters.z_max).number:.2f}" if parameters.z_max > 0 else "z_max = 0"
    ax.set(xlabel="expected range z* [m]", ylabel="reading z [m]", title=f"The fitted density; no return: {none}")
    return figure


def incidence_figure(fit: IncidenceFit) -> Figure:
    """Draw each parameter over the angle of incidence, with standard errors; the pooled fit is dashed."""
    figure = new_figure(12.0, 6.0)
    axes = figure.subplots(2, 3).flat
    edges = np.degrees(fit.parameters.edges)
    middle = 0.5 * (edges[1:] + edges[:-1])
    for ax, name in zip(axes, fit.pooled.standard_errors, strict=True):
        values = [getattr(parameters, name) for parameters in fit.parameters.parameters]
        errors = np.array([bin_fit.standard_errors[name] for bin_fit in fit.fits])
        ax.stairs(values, edges, color=BEAM, baseline=None)
        ax.errorbar(middle, values, np.where(np.isfinite(errors), errors, 0), fmt=".", color=BEAM, capsize=2)
        ax.axhline(getattr(fit.pooled.parameters, name), color=FRAME, ls="--", lw=0.8)
        ax.set(title=name, xlabel="angle of incidence [deg]", xlim=(0, 90))
    return figure


def _near(data: RangeData, distance: float) -> tuple[NDArray[np.bool], float]:
    """Select valid readings with expected ranges near a distance; also return half the interval [m]."""
    width = max(0.03 * distance, 0.02)
    near: Any = (np.abs(data.expected - distance) <= width) & (data.kinds != Reading.MISSING)
    return near, width


def _spaced(values: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Return at most ``count`` values, evenly spaced in rank from least to largest."""
    if not len(values):
        return values
    return np.sort(values)[np.linspace(0, len(values) - 1, min(count, len(values))).astype(int)]


def _top(data: RangeData) -> float:
    """Return an upper limit of axes for most ranges [m]; an office is small compared with a laser's 80 m."""
    ranges = data.ranges[data.kinds == Reading.HIT]
    known = np.concatenate([ranges, data.expected[data.expected < data.range_max]])
    return min(1.1 * float(np.quantile(known, 0.995)), data.range_max) if len(known) else data.range_max
