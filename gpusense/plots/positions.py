"""Draw possible positions from ranges or bearings of beacons, with and without uncertainty.

The pictures follow the lectures' "Distances Only" and "Bearings Only". As in ``drawing``, Matplotlib is imported on
first use.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util import checks
from gpusense._util.typing import Floats
from gpusense.plots.drawing import BEAM, FRAME, OCCUPIED, ROBOT, colours, draw_ellipse, draw_pose
from gpusense.positions.fix import PositionFix
from gpusense.positions.problem import Problem, make_problem

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.image import AxesImage


# Root of the 95 % quantile of chi-squared with two degrees of freedom: semi-axes of an ellipse [sigmas].
SIGMAS_95 = 2.4477468306808166
# Points of a curve.
FINE = 721


def position_log_density(
    points: ArrayLike,
    xy: ArrayLike,
    *,
    ranges: ArrayLike | None = None,
    bearings: ArrayLike | None = None,
    heading: float | None = None,
    sigma_range: ArrayLike | None = None,
    sigma_bearing: ArrayLike | None = None,
) -> Floats:
    """Compute log p(ranges, bearings | x, y): the sum over beacons of the logarithms of Gaussian densities.

    If the heading is unknown, bearings are scored with the best heading at each point (profile likelihood).

    Args:
        points: (..., 2) x and y [m].
        xy: (M, 2) beacons [m].
        ranges: (M,) [m], or None.
        bearings: (M,) [rad], or None.
        heading: The robot's heading [rad], or None.
        sigma_range: Standard deviation of the ranges [m], one or (M,), > 0; required with ranges.
        sigma_bearing: Standard deviation of the bearings [rad], one or (M,), > 0; required with bearings.

    Returns:
        (...) log densities, natural logarithm.

    Raises:
        TypeError, ValueError: an argument is not of the kind described, or breaks its rule.

    Example:
        >>> import gpusense as gs
        >>> beacons = [(0.0, 0.0), (4.0, 0.0)]
        >>> log_p = gs.plots.position_log_density([(2.0, 1.5), (2.0, 0.0)], beacons, ranges=[2.5, 2.5], sigma_range=0.1)
        >>> bool(log_p[0] > log_p[1])
        True
    """
    places = checks.array("points", points)
    if places.ndim < 1 or places.shape[-1] != 2:
        raise ValueError(f"points: shape must be (..., 2), got {checks.shape_text(places.shape)}")
    if ranges is None and bearings is None:
        raise ValueError("ranges: must be given where bearings are not, got None")
    for name, values, sigma in (("range", ranges, sigma_range), ("bearing", bearings, sigma_bearing)):
        if values is not None and sigma is None:
            raise ValueError(f"sigma_{name}: must be given with {name}s, got None")
    problem = make_problem(
        xy, ranges=ranges, bearings=bearings, heading=heading, sigma_range=sigma_range, sigma_bearing=sigma_bearing,
        names=("sigma_range", "sigma_bearing"),
    )  # fmt: skip
    states = (places - problem.origin).reshape(-1, 2)
    if problem.bearings.size and heading is None:
        states = np.column_stack([states, _best_headings(problem, states)])
    scaled = problem.residuals(states) * problem.scales
    norm = np.log(problem.sigmas).sum() + 0.5 * math.log(2 * math.pi) * len(problem.sigmas)
    density: Floats = -0.5 * np.sum(scaled * scaled, axis=1) - norm
    return density.reshape(places.shape[:-1])


def _best_headings(problem: Problem, states: Floats) -> Floats:
    """Return the headings (N,) that fit the bearings best at (N, 2) positions [rad]."""
    offset = problem.points - (states[:, :1] + 1j * states[:, 1:])
    weight = problem.sigma_bearing**-2.0
    heading = np.angle((weight * np.exp(1j * (np.angle(offset) - problem.bearings))).sum(axis=1))
    # Refine the circular mean by the mean of the wrapped residuals.
    for _ in range(2):
        residuals = problem.residuals(np.column_stack([states, heading]))[:, -len(weight) :]
        heading = heading - (residuals @ weight) / weight.sum()
    return heading


def draw_beacons(ax: Axes, xy: ArrayLike) -> None:
    """Draw beacons as dark squares with the labels P1, P2, ....

    Args:
        ax: Axes to draw onto.
        xy: (M, 2) beacons [m].

    Example:
        >>> import gpusense as gs
        >>> gs.plots.draw_beacons(gs.plots.new_figure(6.0, 4.0).subplots(), [(0.0, 0.0), (4.0, 0.0)])
    """
    places = checks.array("xy", xy, ("M", 2))
    ax.scatter(places[:, 0], places[:, 1], marker="s", s=42, c=OCCUPIED, edgecolors="white", linewidths=1.0, zorder=6)
    # Outside the beacons, where no curve between them passes.
    away = places - places.mean(axis=0)
    away /= np.maximum(np.hypot(*away.T), 1e-9)[:, None]
    for k, (place, (x, y)) in enumerate(zip(places, away.tolist(), strict=True)):
        ax.annotate(
            f"P{k + 1}", place, xytext=(12 * x, 12 * y or 12), textcoords="offset points", ha="center", va="center",
            color=OCCUPIED, fontsize=11, zorder=6,
        )  # fmt: skip


def draw_solution_set(
    ax: Axes,
    xy: ArrayLike,
    *,
    ranges: ArrayLike | None = None,
    bearings: ArrayLike | None = None,
    heading: float | None = None,
) -> int:
    """Draw the exact solution set of each measurement: circles, rays or arcs.

    A range allows a circle around its beacon. A bearing and a known heading allow a ray that ends in the beacon. If
    the heading is unknown, the angle between two bearings allows an arc of a circle through both beacons.

    Args:
        ax: Axes to draw onto; set the limits first, since rays are as long as the diagonal.
        xy: (M, 2) beacons [m].
        ranges: (M,) [m], or None.
        bearings: (M,) [rad], or None.
        heading: The robot's heading [rad], or None.

    Returns:
        The number of drawn curves.

    Example:
        >>> import gpusense as gs
        >>> ax = gs.plots.new_figure(6.0, 4.0).subplots()
        >>> gs.plots.draw_solution_set(ax, [(0.0, 0.0), (4.0, 0.0)], ranges=[2.5, 2.5])
        2
    """
    from matplotlib.collections import LineCollection

    problem = make_problem(xy, ranges=ranges, bearings=bearings, heading=heading)
    reach = math.hypot(np.ptp(ax.get_xlim()), np.ptp(ax.get_ylim()))
    curves = _solution_curves(problem, reach)
    lines = [np.column_stack([curve.real, curve.imag]) for curve in curves]
    ax.add_collection(LineCollection(lines, colors=BEAM, linewidths=1.4, zorder=4), autolim=False)
    return len(lines)


def _solution_curves(problem: Problem, reach: float) -> list[NDArray[np.complex128]]:
    """Return the curves of possible positions as complex numbers; rays have length ``reach``."""
    world = problem.points + complex(*problem.origin)
    curves: list[NDArray[np.complex128]] = []
    if problem.ranges.size:
        around = np.exp(1j * np.linspace(0, 2 * np.pi, FINE))
        curves += [m + r * around for m, r in zip(world, problem.ranges, strict=True)]
    if problem.bearings.size and problem.heading is not None:
        away = np.exp(1j * (problem.bearings + problem.heading))
        curves += [np.array([m, m - reach * u]) for m, u in zip(world, away, strict=True)]
    elif problem.bearings.size:
        for i in range(len(world)):
            for j in range(i):
                curves.append(_arc(world[i], world[j], problem.bearings[j] - problem.bearings[i], reach))
    return curves


def draw_fix(ax: Axes, fix: PositionFix, *, length: float = 0.0, ellipses: bool = True) -> None:
    """Draw the solutions of a fix, their headings and the 95 % ellipses of the position.

    Args:
        ax: Axes to draw onto.
        fix: The fix; only finite covariances are drawn.
        length: Length of a heading's arrow [m]; 0 draws none.
        ellipses: Whether to draw ellipses; points instead of rings then mark the solutions.

    Example:
        >>> import gpusense as gs
        >>> fix = gs.trilaterate([(0.0, 0.0), (4.0, 0.0)], [2.5, 2.5], sigma=0.1)
        >>> gs.plots.draw_fix(gs.plots.new_figure(6.0, 4.0).subplots(), fix)
    """
    for solution, covariance in zip(fix.solutions, fix.covariance, strict=True):
        if not ellipses:
            heading = solution[2] if len(solution) == 3 else 0.0
            draw_pose(ax, (*solution[:2], heading), length=length if len(solution) == 3 else 0.0)
            continue
        ax.plot(*solution[:2], marker="o", markersize=5, color=ROBOT, markeredgecolor="white", zorder=7)
        if np.isfinite(covariance).all():
            draw_ellipse(ax, solution[:2], covariance[:2, :2], SIGMAS_95, color="white", linewidth=1.6, zorder=5)


def draw_position_density(
    ax: Axes, log_p: ArrayLike, extent: tuple[float, float, float, float], *, depth: float = 12.0
) -> AxesImage:
    """Draw a log density over x and y, relative to its maximum.

    Args:
        ax: Axes to draw onto.
        log_p: (R, C) log densities at the middles of equal tiles, row 0 at the least y.
        extent: x_min, x_max, y_min, y_max of the tiles [m].
        depth: Extent of the colour scale below the maximum [nats], > 0.

    Returns:
        The image, for :func:`add_colour_bar`.

    Example:
        >>> import gpusense as gs
        >>> ax, extent = gs.plots.new_figure(6.0, 4.0).subplots(), (0.0, 4.0, -2.0, 2.0)
        >>> points = gs.plots.tile_centers(extent, 40)
        >>> log_p = gs.plots.position_log_density(points, [(0.0, 0.0)], ranges=[2.5], sigma_range=0.1)
        >>> image = gs.plots.draw_position_density(ax, log_p, extent)
    """
    value = checks.array("log_p", log_p, ("R", "C"))
    below = np.maximum(value - value.max(initial=-np.inf), -checks.real("depth", depth, above=0))
    return ax.imshow(below, origin="lower", extent=extent, cmap=colours(), vmin=-depth, vmax=0.0, zorder=0)


def tile_centers(extent: tuple[float, float, float, float], count: int) -> Floats:
    """Return the middles (R, C, 2) of square tiles over an extent [m].

    Args:
        extent: x_min, x_max, y_min, y_max [m].
        count: Number of tiles along the longer side.

    Example:
        >>> import gpusense as gs
        >>> gs.plots.tile_centers((0.0, 4.0, 0.0, 2.0), 4).shape
        (2, 4, 2)
    """
    x_min, x_max, y_min, y_max = extent
    side = max(x_max - x_min, y_max - y_min) / count
    cols, rows = max(round((x_max - x_min) / side), 1), max(round((y_max - y_min) / side), 1)
    x = x_min + (np.arange(cols) + 0.5) * (x_max - x_min) / cols
    y = y_min + (np.arange(rows) + 0.5) * (y_max - y_min) / rows
    return np.stack(np.meshgrid(x, y), axis=-1)


def set_view(ax: Axes, extent: tuple[float, float, float, float], title: str) -> None:
    """Set limits, equal scales, axis labels and a title.

    Args:
        ax: The axes.
        extent: x_min, x_max, y_min, y_max [m].
        title: The title.

    Example:
        >>> import gpusense as gs
        >>> gs.plots.set_view(gs.plots.new_figure(6.0, 4.0).subplots(), (0.0, 4.0, -2.0, 2.0), "Distances only")
    """
    ax.set(xlim=extent[:2], ylim=extent[2:], aspect="equal", xlabel="x [m]", ylabel="y [m]")
    ax.set_title(title, loc="left")
    ax.spines[:].set_color(FRAME)
    ax.tick_params(color=FRAME)


def _arc(first: complex, second: complex, angle: float, reach: float) -> NDArray[np.complex128]:
    """Return points p that see both beacons at this angle: second - p = k exp(i angle) (first - p), k > 0."""
    # k = tan(t / 2) is 0 at the second beacon and infinite at the first one.
    t = np.linspace(0, np.pi, FINE)
    turn = np.exp(1j * angle)
    low, high = np.cos(t / 2), np.sin(t / 2) * turn
    with np.errstate(divide="ignore", invalid="ignore"):
        points = first + (second - first) * low / (low - high)
    return np.where(np.abs(points - first) <= 4 * reach, points, complex(np.nan, np.nan))
