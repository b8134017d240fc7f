"""Match a local map with a global one by branch and bound and the correlation of the book's section 6.5."""

from __future__ import annotations

import functools
import math
import threading
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense._util.html import card
from gpusense._util.typing import Floats
from gpusense.backends import Backend, Selection, get_backend
from gpusense.interface.constants import TOP
from gpusense.matching.align import Alignment
from gpusense.matching.pose_grid import Found, PoseGrid, distinct_poses
from gpusense.matching.score_tables import ScoreTables, field_scores
from gpusense.matching.search import Search
from gpusense.tables.distances import distance_transform
from gpusense.world.grid import OccupancyGrid
from gpusense.world.pose_algebra import rotated

# Occupied and free cells of the local map that the search sums; the correlation takes all.
_OCCUPIED, _FREE = 400, 200
# Deviation and cap of the field around the global map's obstacles [cells].
_SIGMA, _CAP = 2.0, 8.0
# Levels of branch and bound, and share of the largest score below the best pose to which modes are searched.
_LEVELS, _DEPTH = 5, 0.02
# Poses nearer than this to a better pose belong to its mode [m, rad].
_MODE_RADIUS, _MODE_ANGLE, _MODES = 0.5, math.radians(10), 10
# Least overlap, as a share of the local map's known cells, and share of the best correlation that makes a rival.
_OVERLAP, _RIVAL = 0.3, 0.95
# Largest move of a pose by the alignment [cells, and steps of heading].
_FARTHEST = 3.0
# Most poses in a window.
_MOST_POSES = 10**10
# Half widths of the window around a guess [m, m, rad].
_WINDOW = (1.0, 1.0, 0.35)


@dataclass(frozen=True, eq=False)
class MapMatch:
    """The result of :func:`match_map`.

    Attributes:
        pose: (3,) pose of the local map's frame in the world: x, y and theta [m, m, rad].
        correlation: Correlation of both maps there, from -1 to 1 (book equation 6.26).
        overlap: Share of the local map's known cells that the global map knows.
        score: Mean score of the search, from 0 to 1.
        modes: (M, 3) poses of distinct matches, by falling correlation; the first is ``pose``.
        correlations: (M,) their correlations.
        status: ``"found"``, ``"ambiguous"`` where another mode correlates as well, or ``"no match"``.
        poses: Number of poses of the search.
        evaluated: Number of poses and blocks of poses that were evaluated.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> cells = np.pad(np.zeros((12, 20), int), 1, constant_values=100)
        >>> cells[1:7, 9] = 100
        >>> grid = gs.OccupancyGrid(cells, resolution=0.1)
        >>> local = gs.OccupancyGrid(cells[:, :14], resolution=0.1)
        >>> bool(np.abs(gs.match_map(local, grid, backend="numpy").pose).max() < 0.01)
        True
    """

    pose: Floats
    correlation: float
    overlap: float
    score: float
    modes: Floats = field(repr=False)
    correlations: Floats = field(repr=False)
    status: Literal["found", "ambiguous", "no match"]
    poses: int
    evaluated: int

    def _repr_html_(self) -> str:
        rows = [
            (f"mode {k}", *pose.round(3).tolist(), float(correlation))
            for k, (pose, correlation) in enumerate(zip(self.modes, self.correlations, strict=True), 1)
        ]
        return card(f"MapMatch: {self.status}", rows, head=("", "x [m]", "y [m]", "theta [rad]", "correlation"))

    @property
    def found(self) -> bool:
        """Return whether a single pose explains the local map."""
        return self.status == "found"


def match_map(
    local_grid: OccupancyGrid,
    grid: OccupancyGrid,
    guess: ArrayLike | None = None,
    window: ArrayLike | None = None,
    *,
    angle: float = 0.0175,
    min_correlation: float = 0.4,
    backend: Selection = "auto",
) -> MapMatch:
    """Find the pose of a local map in a global one, in a window or without a guess.

    The search sums scores of the local map's occupied cells in the likelihood field of the global map, and of its free
    cells in the global map's free cells; branch and bound finds the poses of the largest sums exactly. From each of
    these and its neighbours, the pose with the largest correlation of both maps (*Probabilistic Robotics* equation
    6.26) over cells known to both is aligned to a fraction of a cell, by least squares between the smoothed maps (Lucas
    and Kanade 1981). The result is the aligned pose with the largest correlation.

    Args:
        local_grid: The local map; its resolution may differ.
        grid: The global map. Positions are its cells.
        guess: (3,) pose of the local map's frame in the world [m, m, rad]. None: the whole map is searched.
        window: (3,) half widths in x, y and theta around the guess [m, m, rad]; all poses within it are searched, and
            some beyond. None: 1 m, 1 m and 0.35 rad.
        angle: Angle between neighbouring headings [rad], > 0.
        min_correlation: Correlation below which there is no match, from 0 to 1.
        backend: The device, see :func:`gpusense.devices`.

    Raises:
        TypeError: an argument is of the wrong kind.
        ValueError: an argument breaks its rule, there is a window without a guess, or the local map has no occupied
            cell.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> cells = np.pad(np.zeros((12, 20), int), 1, constant_values=100)
        >>> cells[1:7, 9] = 100
        >>> local, grid = (gs.OccupancyGrid(cells[:, :end], resolution=0.1) for end in (14, 22))
        >>> gs.match_map(local, grid, guess=(0.2, 0.1, 0.05), backend="numpy").status
        'found'
    """
    for name, value in (("local_grid", local_grid), ("grid", grid)):
        if not isinstance(value, OccupancyGrid):
            raise TypeError(f"{name}: must be an OccupancyGrid, got {checks.show(value)}")
    turn = checks.real("angle", angle, above=1e-4, high=math.pi / 2)
    least = checks.real("min_correlation", min_correlation, low=0, high=1)
    if guess is None and window is not None:
        raise ValueError("window: must be given with a guess, got guess=None")
    if not local_grid.occupied.any():
        raise ValueError("local_grid: must have an occupied cell, got none")
    device = get_backend(backend)
    local = _Local(local_grid, grid.resolution)
    if guess is None:
        # The yaw turns the local map's cells.
        turns = 4 * math.ceil(math.pi / 2 / turn - 1e-9)
        searched = PoseGrid.whole(grid.shape, turns, yaw=local_grid.origin[2])
    else:
        searched = _around(grid, local, guess, window, turn)
    slack = math.ceil(_DEPTH * TOP * len(local.points))
    with _LOCK:
        search = _search_of(grid, device)
        levels = min(search.tables.levels, _levels_of(searched.height, searched.width))
        # With all levels available, the search chooses.
        level = None if levels == search.tables.levels else levels
        found = search.find([local.points], searched, slack=slack, level=level, images=[local.images])
    return _result(local_grid, local, grid, searched, found, least)


_LOCK = threading.Lock()


def _levels_of(height: int, width: int) -> int:
    """Return the levels of branch and bound over positions."""
    return min(_LEVELS, int(math.log2(max(min(height, width) / 4, 1))))


@functools.lru_cache(maxsize=2)
def _search_of(grid: OccupancyGrid, device: Backend) -> Search:
    """Return the search in a global map; tables of the last maps are kept."""
    return Search(ScoreTables(device, _scores(grid, backend=device), levels=_levels_of(*grid.shape)))


class _Local:
    """The known cells of a local map around their middle.

    ``middle`` (2,) is the centre of the known cell in their middle, in the local map's frame [m]; ``xy`` (M, 2) are
    their centres around it [cells of the global map]. The search sums the cells ``points`` (K, 2) in tables ``images``
    (K,): 0 for occupied, 1 for free cells.
    """

    def __init__(self, grid: OccupancyGrid, cell: float) -> None:
        row, col = np.nonzero(~grid.unknown)
        centers, cells = grid.cell_centers(row, col), np.stack([row, col], axis=1)
        middle = (cells.min(axis=0) + cells.max(axis=0)) / 2
        # The middle is the centre of a cell, so that maps with coincident cells match exactly.
        self.middle = centers[np.hypot(*(cells - middle).T).argmin()]
        self.xy = (centers - self.middle) / cell
        self.occupied = occupied = grid.occupied[row, col]
        chosen = [_thinned(np.flatnonzero(mask), most) for mask, most in ((occupied, _OCCUPIED), (~occupied, _FREE))]
        self.points = self.xy[np.concatenate(chosen)]
        self.images = np.repeat([0, 1], [len(part) for part in chosen])


def _thinned(index: np.ndarray, most: int) -> np.ndarray:
    """Return at most ``most`` of the indices, evenly spaced."""
    return index if len(index) <= most else index[np.arange(most) * len(index) // most]


def _scores(grid: OccupancyGrid, *, backend: Backend) -> np.ndarray:
    """Return (2, H, W) scores of occupied and of free cells of a local map in the global one."""
    field = field_scores(distance_transform(grid.occupied, backend=backend), _SIGMA, _CAP)
    free = np.where(grid.free, TOP, np.where(grid.occupied, 0, TOP // 2)).astype(np.uint8)
    return np.stack([field, free])


def _around(grid: OccupancyGrid, local: _Local, guess: ArrayLike, window: ArrayLike | None, angle: float) -> PoseGrid:
    """Return the poses in a window around a guess, in the frame of the global map."""
    x, y, theta = checks.array("guess", guess, (3,), largest=checks.FARTHEST).tolist()
    half = checks.array("window", _WINDOW if window is None else window, (3,), largest=checks.FARTHEST)
    if (half < 0).any():
        raise ValueError(f"window: must be at least 0, got {checks.show(window)}")
    cos, sin = math.cos(theta), math.sin(theta)
    middle = np.array(
        [[x + cos * local.middle[0] - sin * local.middle[1], y + sin * local.middle[0] + cos * local.middle[1]]]
    )
    center = np.column_stack([grid.world_to_cells(middle), [theta - grid.origin[2]]])
    # Rotations of the frame move the middle; the window's axes are parallel to the world's.
    yaw_cos, yaw_sin = abs(math.cos(grid.origin[2])), abs(math.sin(grid.origin[2]))
    swing = 2 * math.hypot(*local.middle) * math.sin(min(half[2], math.pi) / 2)
    wide = np.array([yaw_cos * half[0] + yaw_sin * half[1], yaw_sin * half[0] + yaw_cos * half[1]]) + swing
    reach = np.ceil(wide / grid.resolution - 1e-9).astype(int)
    turns = math.ceil(min(half[2], math.pi) / angle - 1e-9)
    poses = math.prod(2 * int(each) + 1 for each in (*reach, turns))
    if poses > _MOST_POSES:
        raise ValueError(f"window: must hold at most {_MOST_POSES:.0e} poses, got {poses:.3g} in {checks.show(window)}")
    return PoseGrid.around(center, (int(reach[1]), int(reach[0])), turns, angle)


def _result(
    local_grid: OccupancyGrid, local: _Local, grid: OccupancyGrid, searched: PoseGrid, found: Found, least: float
) -> MapMatch:
    """Return the match among the poses of a search and their neighbours."""
    poses = searched.poses(found, 1)
    chosen = distinct_poses(poses, _MODES, _MODE_RADIUS / grid.resolution, _MODE_ANGLE)
    angle = float(np.diff(searched.headings[0]).max(initial=0.0))
    states = _states(grid)
    best = [_best_near(local, states, pose, angle) for pose in poses[chosen]]
    alignment = Alignment(local_grid, local.xy, grid, np.array(best), _FARTHEST)
    best = [alignment.refined(pose, _FARTHEST * angle) for pose in best]
    values, overlaps = np.array([_correlations(local, states, pose, [(0, 0)])[0] for pose in best]).T
    order = np.argsort(-values, kind="stable")
    modes, correlations = _to_world(local, grid, np.array(best)[order]), values[order]
    rivals = correlations[1:] >= max(_RIVAL * correlations[0], least)
    status: Literal["found", "ambiguous", "no match"] = "found"
    if correlations[0] < least:
        status = "no match"
    elif rivals.any():
        status = "ambiguous"
    return MapMatch(
        modes[0], float(correlations[0]), float(overlaps[order[0]]), float(found.score[chosen[order[0]]])
        / (TOP * len(local.points)), modes, correlations, status, searched.count, found.evaluated,
    )  # fmt: skip


def _states(grid: OccupancyGrid) -> np.ndarray:
    """Return the cells with a margin of two: 0 for unknown, 1 for free, 2 for occupied."""
    return np.pad((grid.cells >= 0).astype(np.int8) + grid.occupied, 2)


def _best_near(local: _Local, states: np.ndarray, pose: np.ndarray, angle: float) -> np.ndarray:
    """Return the pose with the largest correlation among a pose of the grid and its neighbours."""
    shifts = [(row, col) for row in (0, -1, 1) for col in (0, -1, 1)]
    # The pose itself comes first and wins ties, then come other positions at its heading.
    turned = [pose + np.array([0.0, 0.0, turn * angle]) for turn in (0, -1, 1)]
    measured = np.array([_correlations(local, states, each, shifts) for each in turned])[..., 0]
    turn, shift = divmod(int(measured.argmax()), len(shifts))
    row, col = shifts[shift]
    near: np.ndarray = turned[turn] + np.array([col, row, 0.0])
    return near


def _correlations(
    local: _Local, states: np.ndarray, pose: np.ndarray, shifts: list[tuple[int, int]]
) -> list[tuple[float, float]]:
    """Return the correlation of both maps over cells known to both (book equation 6.26), and the share of these cells.

    With m 1 for occupied and 0 for free cells, and its mean over both maps, the correlation is the sum of (m - mean)
    (m_local - mean) over the root of the product of the sums of (m - mean)^2 and (m_local - mean)^2. Below the least
    overlap it is -1. There is a pair for each shift by rows and columns, of at most one cell.
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    x, y = local.xy[:, 0], local.xy[:, 1]
    rows, cols = states.shape
    col = np.clip(np.floor(pose[0] + (cos * x - sin * y)) + 2, 1, cols - 2).astype(np.int64)
    place = np.clip(np.floor(pose[1] + (sin * x + cos * y)) + 2, 1, rows - 2).astype(np.int64) * cols + col
    return [_correlation(states.ravel()[place + (row * cols + col)], local.occupied) for row, col in shifts]


def _correlation(state: np.ndarray, occupied: np.ndarray) -> tuple[float, float]:
    """Return the correlation of states of cells with the local map, and the share of the known cells."""
    known = np.count_nonzero(state)
    overlap = known / len(state)
    if overlap < _OVERLAP:
        return -1.0, overlap
    ours = np.count_nonzero(np.where(occupied, state, 0))
    full = state == 2
    theirs, both = np.count_nonzero(full), np.count_nonzero(full & occupied)
    mean = (theirs + ours) / (2 * known)
    square, local_square = (count * (1 - 2 * mean) + known * mean**2 for count in (theirs, ours))
    scale = math.sqrt(square * local_square)
    return ((both - mean * (theirs + ours) + known * mean**2) / scale if scale > 0 else 0.0), overlap


def _to_world(local: _Local, grid: OccupancyGrid, poses: np.ndarray) -> Floats:
    """Return poses of the local map's frame in the world, from poses of its middle in the global map's cells."""
    placed = grid._poses_to_world(poses)
    placed[:, :2] -= rotated(local.middle[None], poses[:, 2] + grid.origin[2])
    return placed
