"""P(z | x, m) over all positions and headings of a map (Thrun, Burgard and Fox, figures 6.3 and 6.8)."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util import checks, pictures
from gpusense._util.angles import wrapped
from gpusense._util.typing import Floats
from gpusense.matching.pose_grid import distinct_poses
from gpusense.models.scan.model import ScanModel
from gpusense.tables.world_map import check_one_map
from gpusense.world.grid import OccupancyGrid

# Poses of one call of the model, and most poses of a map.
_TILE, _MOST = 1 << 19, 1 << 30
# Poses nearer than this to a better one are no modes [m, rad].
_NEAR, _TURN = 0.5, 0.26
# Refinement of a pose: levels, and offsets per axis of a level in units of its reach, which halves from level to level.
_LEVELS, _OFFSETS = 8, (-1.0, -0.5, 0.0, 0.5, 1.0)


@dataclass(frozen=True, eq=False)
class PoseLikelihood:
    """Log-likelihoods of a scan over a lattice of poses; the result of :func:`pose_likelihood`.

    Attributes:
        grid: The map.
        log_p: (H', W', A) log p(z | x, m) at each row, column and heading; NaN where it was not evaluated.
        headings: (A,) headings in the world [rad].
        step: Cells between neighbouring positions: the side of a tile.
        cells: (H', W', 2) row and column of the cell of each position.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> grid, scanner = gs.OccupancyGrid([[0, 0, 100]], 1.0), gs.Scanner([0.0], 9.0)
        >>> model = gs.LikelihoodFieldModel(grid, scanner, backend="numpy")
        >>> p = gs.pose_likelihood(model, [1.9], resolution=1.0, headings=4)
        >>> p.log_p.shape, np.unravel_index(p.log_p.argmax(), p.log_p.shape)[2] == 0
        ((1, 3, 4), np.True_)
    """

    grid: OccupancyGrid = field(repr=False)
    log_p: NDArray[np.floating] = field(repr=False)
    headings: Floats = field(repr=False)
    step: int
    cells: NDArray[np.int64] = field(repr=False)

    @property
    def resolution(self) -> float:
        """Side of a tile, the usual distance between neighbouring positions [m]."""
        return self.step * self.grid.resolution

    def poses(self, row: ArrayLike, col: ArrayLike, heading: ArrayLike) -> Floats:
        """Return the (M, 3) poses in the world [m, m, rad] at M indices of rows, columns and headings."""
        rows, cols = self.cells.shape[:2]
        sized = ("row", row, rows), ("col", col, cols), ("heading", heading, len(self.headings))
        found = checks.broadcast({name: checks.indices(name, value, size) for name, value, size in sized})
        row, col, heading = (index.ravel() for index in found)
        xy = self.grid._to_world((self.cells[row, col][:, ::-1] + 0.5) * self.grid.resolution)
        return np.column_stack([xy, self.headings[heading]])

    @property
    def log_evidence(self) -> float:
        """Log of the mean of p(z | x, m) over the evaluated poses: log p(z | m) for a uniform prior."""
        known = ~np.isnan(self.log_p)
        count = np.count_nonzero(known)
        return _log_sum(self.log_p) - math.log(count) if count else -math.inf

    @property
    def probability(self) -> Floats:
        """(H', W', A) posterior of each pose for a uniform prior; the sum is 1, or 0 if no pose is possible."""
        total = _log_sum(self.log_p)
        if total == -math.inf:
            return np.zeros(self.log_p.shape)
        return np.nan_to_num(np.exp(self.log_p.astype(np.float64) - total), nan=0.0)

    @property
    def marginal(self) -> Floats:
        """(H', W') posterior of each position, the sum over headings."""
        summed: Floats = self.probability.sum(axis=2)
        return summed

    @property
    def entropy(self) -> float:
        """Entropy of the posterior over poses [nats]; the log of the number of poses where nothing is known."""
        p = self.probability
        p = p[p > 0]
        return float(-(p * np.log(p)).sum())

    def modes(self, count: int = 10, *, radius: float = _NEAR, angle: float = _TURN) -> tuple[Floats, Floats]:
        """Return the local maxima: poses that are not near a better one.

        Args:
            count: Largest number of modes.
            radius: Modes nearer than this to a better one are suppressed [m], unless their heading differs.
            angle: Least difference of heading of modes that are near each other [rad].

        Returns:
            (M, 3) poses [m, m, rad], headings in (-pi, pi], and (M,) log-likelihoods, the best first. Impossible poses
            are left out.
        """
        checks.integer("count", count, low=1)
        near, turn = checks.real("radius", radius, low=0), checks.real("angle", angle, low=0)
        left = np.where(np.isnan(self.log_p), -np.inf, self.log_p)
        poses: list[Floats] = []
        log_p: list[float] = []
        radius = min(near / self.resolution, 2.0 * max(left.shape[:2]))
        reach = int(radius)
        distant = np.abs(wrapped(np.subtract.outer(self.headings, self.headings)))
        rows, cols = np.mgrid[-reach : reach + 1, -reach : reach + 1]
        disc = rows**2 + cols**2 <= radius**2
        while len(log_p) < count:
            row, col, heading = np.unravel_index(int(left.argmax()), left.shape)
            if left[row, col, heading] == -np.inf:
                break
            poses.append(self.poses(row, col, heading)[0])
            log_p.append(float(left[row, col, heading]))
            i, j = rows[disc] + row, cols[disc] + col
            inside = (i >= 0) & (i < left.shape[0]) & (j >= 0) & (j < left.shape[1])
            around = np.flatnonzero(distant[heading] <= turn)
            left[i[inside, None], j[inside, None], around] = -np.inf
        found = np.array(poses).reshape(-1, 3)
        found[:, 2] = -wrapped(-found[:, 2])
        return found, np.array(log_p)

    def __repr__(self) -> str:
        rows, cols, headings = self.log_p.shape
        best = self.modes(1)[0]
        at = "{:.2f} m, {:.2f} m, {:.2f} rad".format(*best[0]) if len(best) else "nowhere"
        return (
            f"PoseLikelihood({rows} x {cols} positions of {self.resolution:g} m, {headings} headings; best at {at}, "
            f"entropy {self.entropy:.3g} nats)"
        )

    def plot(self, path: str | os.PathLike[str]) -> None:
        """Draw the map and the likelihood of each position, and write the picture; see ``gs.plots``.

        Args:
            path: A path that ends in .png, .pdf, .svg or another format that Matplotlib writes.

        Raises:
            ImportError: Matplotlib is not installed.
        """
        pictures.draw("pose likelihood", self, path)


def pose_likelihood(
    model: ScanModel,
    ranges: ArrayLike,
    *,
    resolution: float = 0.1,
    headings: int = 72,
    positions: Literal["free", "all"] = "all",
) -> PoseLikelihood:
    """Compute P(z | x, m) over all positions and headings of a map.

    The map is divided into square tiles, counted from its first corner; tiles at its far edges may be smaller. Each
    position is the centre of a tile's middle cell. Headings are 0, 2 pi / A, ... in the world. The model evaluates
    poses in batches, so memory is limited to the result.

    Args:
        model: A scan model: its map, parameters and device are used.
        ranges: (K,) readings [m].
        resolution: Distance between neighbouring positions [m], > 0; rounded to whole cells, at least one.
        headings: Number A of headings.
        positions: ``"all"``; or ``"free"``, where each position is the centre of the free cell nearest to the tile's
            middle, and tiles without a free cell are left out.

    Raises:
        TypeError: the model is no scan model, or an argument is of the wrong kind.
        ValueError: an argument breaks its rule, or there are more than 2^30 poses.

    Example:
        >>> import gpusense as gs
        >>> grid = gs.OccupancyGrid([[0, 0, 100], [0, 0, 100]], resolution=0.5)
        >>> model = gs.BeamModel(grid, gs.Scanner([0.0], range_max=4.0), backend="numpy")
        >>> gs.pose_likelihood(model, [0.75], resolution=0.5, headings=4, positions="free").marginal.round(2).tolist()
        [[0.48, 0.02, 0.0], [0.48, 0.02, 0.0]]
    """
    result, tiles = prepare_tiles(model, ranges, resolution=resolution, headings=headings, positions=positions)
    for _ in tiles:
        pass
    return result


def prepare_tiles(
    model: ScanModel, ranges: ArrayLike, *, resolution: float, headings: int, positions: Literal["free", "all"]
) -> tuple[PoseLikelihood, Iterator[float]]:
    """Return the result, empty so far, and an iterator that fills it tile by tile and yields the share that is done."""
    if not isinstance(model, ScanModel):
        raise TypeError(f"model: must be a BeamModel or LikelihoodFieldModel, got {checks.show(model)}")
    check_one_map("model", model)
    grid = model.grid
    step = max(round(checks.real("resolution", resolution, above=0, high=checks.FARTHEST) / grid.resolution), 1)
    count = checks.integer("headings", headings, low=1)
    checks.choice("positions", positions, ("free", "all"))
    z = checks.array("ranges", ranges, (model.scanner.count,), finite=False, dtype=None)
    rows, cols = (-(-size // step) for size in grid.shape)
    if rows * cols * count > _MOST:
        raise ValueError(f"resolution: there must be at most {_MOST} poses, got {rows} x {cols} x {count}")
    log_p = np.full((rows, cols, count), np.nan, model.precision)
    directions: Floats = 2 * math.pi / count * np.arange(count, dtype=np.float64)
    if positions == "free":
        cells, evaluated = _free_cells(grid.free, step)
    else:
        cells = np.stack(np.meshgrid(*(_middles(size, step) for size in grid.shape), indexing="ij"), axis=-1)
        evaluated = np.ones((rows, cols), bool)
    result = PoseLikelihood(grid, log_p, directions, step, cells)
    return result, _fill(model, z, result, evaluated)


def refine_modes(
    model: ScanModel, ranges: ArrayLike, likelihood: PoseLikelihood, count: int
) -> tuple[Floats, Floats, float]:
    """Refine the best poses of a lattice between its positions and headings.

    Return ``count`` poses (M, 3) [m, m, rad] of four times as many that are refined, and their (M,) log-likelihoods,
    the best first, and the gain of the best one over the lattice [nats], large if the lattice is coarser than the
    model's peaks.
    """
    poses, log_p = likelihood.modes(4 * count)
    if not len(poses):
        return poses, log_p, 0.0
    best = log_p[0]
    reach = np.array([likelihood.resolution, likelihood.resolution, 2 * math.pi / len(likelihood.headings)])
    offsets = np.stack(np.meshgrid(*[_OFFSETS] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    for level in range(_LEVELS):
        tried = (poses[:, None] + offsets * reach / 2**level).reshape(-1, 3)
        values = np.asarray(model.log_likelihood(tried, ranges), np.float64).reshape(len(poses), -1)
        chosen = values.argmax(axis=1)
        poses = tried.reshape(len(poses), -1, 3)[np.arange(len(poses)), chosen]
        log_p = values.max(axis=1)
    poses[:, 2] = -wrapped(-poses[:, 2])
    order = np.argsort(-log_p, kind="stable")
    kept = order[distinct_poses(poses[order], count, _NEAR, _TURN)]
    return poses[kept], log_p[kept], float(log_p[kept[0]] - best)


def _middles(size: int, step: int) -> NDArray[np.int64]:
    """Return the middle index of each part of an axis; the last part may be shorter than a step."""
    first = np.arange(0, size, step)
    middles: NDArray[np.int64] = first + np.minimum(step, size - first) // 2
    return middles


def _free_cells(free: NDArray[np.bool], step: int) -> tuple[NDArray[np.int64], NDArray[np.bool]]:
    """Return the free cell (H', W', 2) nearest to the middle of each tile, and which tiles (H', W') have one.

    Of equally near cells the lowest column counts, then the lowest row. Tiles without a free cell have their middle.
    """
    far, sides = np.iinfo(np.int64).max, [min(step, size) for size in free.shape]
    middles = [_middles(size, step) for size in free.shape]
    cells = np.stack(np.meshgrid(*middles, indexing="ij"), axis=-1)
    (rows, cols), (high, wide) = cells.shape[:2], sides
    down, across = (np.arange(size) - np.repeat(middle, side)[:size]
                    for size, side, middle in zip(free.shape, sides, middles, strict=True))  # fmt: skip
    squared = np.full((rows * high, cols * wide), far)
    squared[: len(down), : len(across)] = np.where(free, down[:, None] ** 2 + across**2, far)
    tiles = squared.reshape(rows, high, cols, wide).transpose(0, 2, 3, 1).reshape(rows, cols, -1)
    nearest, has_free = tiles.argmin(axis=2), tiles.min(axis=2) < far
    within = np.stack([nearest % high, nearest // high], axis=-1) + np.moveaxis(np.mgrid[:rows, :cols], 0, -1) * sides
    cells[has_free] = within[has_free]
    return cells, has_free


def _fill(model: ScanModel, ranges: np.ndarray, result: PoseLikelihood, evaluated: np.ndarray) -> Iterator[float]:
    """Evaluate the poses of some of the tiles of a result, in batches."""
    count = len(result.headings)
    row, col = np.nonzero(evaluated)
    each = max(_TILE // count, 1)
    for first in range(0, len(row), each):
        part = slice(first, min(first + each, len(row)))
        i, j = row[part], col[part]
        poses = result.poses(np.repeat(i, count), np.repeat(j, count), np.tile(np.arange(count), len(i)))
        result.log_p[i, j] = model.log_likelihood(poses, ranges).reshape(len(i), count)
        yield part.stop / len(row)


def _log_sum(log_p: np.ndarray) -> float:
    """Return the log of the sum of probabilities; NaN counts as 0."""
    known = log_p[~np.isnan(log_p)].astype(np.float64)
    high = known.max(initial=-np.inf)
    return float(high + np.log(np.exp(known - high).sum())) if np.isfinite(high) else float(high)
