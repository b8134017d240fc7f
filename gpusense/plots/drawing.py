"""Draw maps, scans and poses onto a Matplotlib ``Axes``.

Matplotlib is imported on first use. ``pyplot`` and its global state are never used: make a figure with
:func:`new_figure`, draw, and write it with :func:`save`.
"""

from __future__ import annotations

import math
import os
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util import checks
from gpusense._util.files import write_whole
from gpusense.world.frames import ray_vectors
from gpusense.world.grid import OccupancyGrid
from gpusense.world.pose_algebra import compose_poses
from gpusense.world.scanner import Reading, Scanner, classify

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage
    from matplotlib.transforms import Transform

FREE, UNKNOWN, OCCUPIED = "#ffffff", "#dfe3e8", "#4a5568"
BEAM, ROBOT, FRAME = "#0077b6", "#d7263d", "#9aa5b1"
# Meanings that have one colour in all pictures.
REFERENCE, ESTIMATE, CLOUD, CLOSED = "#8fa3b8", "#e4572e", "#4c78a8", "#3c8d4f"
VERDICTS = {"tracking": "#2a7f3f", "uncertain": "#b26b00", "lost": "#b3261e"}
# Colours from unlikely to likely with falling lightness, readable on paper, in grey and with colour blindness.
SCALE = ("#eef1f5", "#ffd166", "#f3722c", "#b5179e", "#3a0ca3")
# Dots per inch of a saved image; clouds of points are also rasterised in vector formats.
DPI = 150


def new_figure(width: float, height: float) -> Figure:
    """Make an empty figure with a constrained layout.

    Args:
        width: Width [inches].
        height: Height [inches].

    Example:
        >>> import gpusense as gs
        >>> gs.plots.new_figure(6.0, 4.0).get_size_inches().tolist()
        [6.0, 4.0]
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def draw_map(ax: Axes, grid: OccupancyGrid) -> AxesImage:
    """Draw a map: occupied cells dark, unknown cells grey, free cells white; axes in metres of the world.

    Free cells are transparent to :func:`draw_pose_density`.

    Args:
        ax: Axes to draw onto.
        grid: The map; its origin's yaw rotates the picture.

    Returns:
        The image of the map.

    Example:
        >>> import gpusense as gs
        >>> ax = gs.plots.new_figure(6.0, 4.0).subplots()
        >>> image = gs.plots.draw_map(ax, gs.worlds.building())
        >>> ax.get_xlabel()
        'x [m]'
    """
    from matplotlib.colors import to_rgba

    palette = np.array([to_rgba(FREE), to_rgba(UNKNOWN), to_rgba(OCCUPIED)], dtype=np.float32)
    kinds = np.where(grid.occupied, 2, np.where(grid.unknown, 1, 0))
    _over_grid(ax, grid, palette[kinds], zorder=0)
    palette[0, 3] = 0  # free cells of the upper layer show the layers in between
    image = _over_grid(ax, grid, palette[kinds], zorder=2)
    x_min, y_min, x_max, y_max = grid.bounds()
    ax.set(xlim=(x_min, x_max), ylim=(y_min, y_max), aspect="equal", xlabel="x [m]", ylabel="y [m]")
    ax.set_facecolor(UNKNOWN)
    ax.spines[:].set_color(FRAME)
    ax.tick_params(color=FRAME)
    return image


def draw_scan(ax: Axes, grid: OccupancyGrid, scanner: Scanner, pose: ArrayLike, ranges: ArrayLike) -> int:
    """Draw a scan at a pose: thin beams, their end points, the robot.

    Only readings with a range are drawn.

    Args:
        ax: Axes to draw onto, usually after :func:`draw_map`.
        grid: The map; its size sets the length of the robot's arrow.
        scanner: The scanner's geometry, mount included.
        pose: (3,) the robot's x, y and theta in the world [m, m, rad].
        ranges: (K,) readings [m].

    Returns:
        The number of drawn readings.

    Example:
        >>> import gpusense as gs
        >>> ax = gs.plots.new_figure(6.0, 4.0).subplots()
        >>> scanner = gs.Scanner([-0.5, 0.0, 0.5], range_max=5.0)
        >>> gs.plots.draw_scan(ax, gs.worlds.building(), scanner, (4.0, 3.0, 0.0), [2.0, float("inf"), 3.0])
        2
    """
    from matplotlib.collections import LineCollection

    x, y, theta = checks.array("pose", pose, (3,)).tolist()
    z = checks.array("ranges", ranges, (scanner.count,), finite=False, dtype=None)
    start, ends = compose_poses((x, y, theta), scanner.mount)[:2], end_points(z, scanner, (x, y, theta))
    beams = np.stack([np.broadcast_to(start, ends.shape), ends], axis=1)
    ax.add_collection(LineCollection(list(beams), colors=BEAM, linewidths=0.6, alpha=0.35, zorder=4), autolim=False)
    ax.scatter(ends[:, 0], ends[:, 1], s=9, c=BEAM, linewidths=0, zorder=5)
    draw_pose(ax, (x, y, theta), length=0.07 * max(grid.width, grid.height))
    return len(ends)


def end_points(ranges: ArrayLike, scanner: Scanner, pose: ArrayLike = (0.0, 0.0, 0.0)) -> NDArray[np.float64]:
    """Return the (M, 2) end points of the hits of a scan at a (3,) pose of the robot [m]."""
    z = np.asarray(checks.filled(ranges))
    hit = classify(z, scanner) == Reading.HIT
    x, y, theta = np.asarray(pose, np.float64)
    c, s = np.cos(theta), np.sin(theta)
    points = z[hit, None] * ray_vectors(scanner.bearings, scanner.mount)[hit] + np.array(scanner.mount[:2])
    return points @ np.array([[c, s], [-s, c]]) + (x, y)


def draw_pose(ax: Axes, pose: ArrayLike, *, length: float, colour: str = ROBOT) -> None:
    """Draw a pose: a ring at its position and an arrow along its heading.

    Args:
        ax: Axes to draw onto.
        pose: (3,) x, y and theta in the world [m, m, rad].
        length: Length of the arrow [m]; 0 draws none.
        colour: Colour of ring and arrow.

    Example:
        >>> import gpusense as gs
        >>> gs.plots.draw_pose(gs.plots.new_figure(6.0, 4.0).subplots(), (1.0, 2.0, 0.5), length=0.5)
    """
    x, y, theta = checks.array("pose", pose, (3,)).tolist()
    if length > 0:
        tip = (x + length * math.cos(theta), y + length * math.sin(theta))
        style = {"arrowstyle": "-|>", "color": colour, "linewidth": 2.0, "shrinkA": 7, "shrinkB": 0}
        ax.annotate("", xy=tip, xytext=(x, y), arrowprops=style, zorder=6)
    for width, edge in ((3.5, "white"), (1.8, colour)):
        ax.plot([x], [y], marker="o", markersize=15, markerfacecolor="none", markeredgecolor=edge,
                markeredgewidth=width, linestyle="none", zorder=7)  # fmt: skip


def draw_ellipse(ax: Axes, xy: ArrayLike, covariance: NDArray[np.float64], deviations: float, **style: Any) -> None:
    """Draw the ellipse of some standard deviations of a (2, 2) covariance around a point."""
    from matplotlib.patches import Ellipse

    values, axes = np.linalg.eigh(covariance)
    width, height = 2 * deviations * np.sqrt(np.maximum(values, 0.0))
    angle, (x, y) = math.degrees(math.atan2(axes[1, 0], axes[0, 0])), np.asarray(xy, np.float64)
    ax.add_patch(Ellipse((float(x), float(y)), width, height, angle=angle, fill=False, **style))


def add_legend(ax: Axes, columns: int = 4) -> None:
    """Draw the legend below an axes, where it hides nothing.

    Args:
        ax: The axes.
        columns: Largest number of columns.

    Example:
        >>> import gpusense as gs
        >>> ax = gs.plots.new_figure(6.0, 4.0).subplots()
        >>> line = ax.plot([0, 1], [0, 1], label="path")
        >>> gs.plots.add_legend(ax)
        >>> ax.get_legend().get_texts()[0].get_text()
        'path'
    """
    # The distance leaves room for the label of the axis.
    ax.legend(
        loc="upper center", bbox_to_anchor=(0.5, 0.0), borderaxespad=4.5, ncols=columns, fontsize="small", frameon=False
    )


def add_colour_bar(ax: Axes, mappable: Any, label: str) -> None:
    """Add a colour bar to axes, with an arrow at its low end for values below the scale.

    Args:
        ax: The axes.
        mappable: Image or collection with the colours, from a drawing function.
        label: The bar's label.

    Example:
        >>> import gpusense as gs
        >>> ax = gs.plots.new_figure(6.0, 4.0).subplots()
        >>> gs.plots.add_colour_bar(ax, gs.plots.draw_particles(ax, [(0.0, 0.0, 0.0)], [-1.0]), "log p [nats]")
    """
    bar = ax.figure.colorbar(mappable, cax=ax.inset_axes((1.015, 0.0, 0.02, 1.0)), extend="min")
    bar.set_label(label)
    bar.ax.set_title("", y=1.0)
    bar.outline.set_edgecolor(FRAME)


def save(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Write a figure atomically, in the format of the path's suffix.

    Args:
        figure: The figure.
        path: A path that ends in .png, .pdf, .svg or another format that Matplotlib writes.

    Raises:
        ValueError: Matplotlib has no format for the suffix.

    Example:
        >>> import gpusense as gs
        >>> gs.plots.save(gs.plots.new_figure(6.0, 4.0), "empty.png")
    """
    target = checks.path("path", path)
    kind = target.suffix.lower().removeprefix(".")
    formats = figure.canvas.get_supported_filetypes()
    if kind not in formats:
        raise ValueError(f"path: must end in one of {', '.join('.' + name for name in formats)}, got {target}")
    options: dict[str, Any] = {}
    engine = figure.get_layout_engine()
    if kind == "png":
        # Twice as fast as the default level, for a file that is a sixth larger.
        options["pil_kwargs"] = dict(compress_level=3)
        if engine is not None and figure.axes:
            # Matplotlib would draw the whole figure once more for its layout.
            engine.execute(figure)
            figure.set_layout_engine(None)
    try:
        write_whole(target, lambda stream: figure.savefig(stream, format=kind, **options))
    finally:
        figure.set_layout_engine(engine)


def colours() -> Colormap:
    """Return the colour map of all likelihoods, from unlikely to likely.

    Example:
        >>> import gpusense as gs
        >>> gs.plots.colours().name
        'gpusense'
    """
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("gpusense", SCALE)


def _over_grid(
    ax: Axes, grid: OccupancyGrid, values: NDArray[Any], extent: tuple[float, float] | None = None, **options: Any
) -> AxesImage:
    """Draw an image from the grid's corner on, transformed by the grid's origin."""
    from matplotlib.transforms import Affine2D

    x, y, yaw = grid.origin
    width, height = (grid.width, grid.height) if extent is None else extent
    place: Transform = Affine2D().rotate(yaw).translate(x, y) + ax.transData
    return ax.imshow(values, origin="lower", extent=(0.0, width, 0.0, height), transform=place, **options)
