"""Change a world after its map was made: walls and furniture are moved, removed, added, or become glass."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util import checks
from gpusense._util.typing import Flags
from gpusense.world.grid import OccupancyGrid

Rng = np.random.Generator
# Side of the pieces of walls that move, and the least and largest distance of their move [m].
_PIECE, _NEAREST, _FARTHEST = 1.0, 0.5, 2.0
_ATTEMPTS = 8
# Half sides of new furniture [m].
_SMALLEST, _LARGEST = 0.15, 0.6
_FREE, _OCCUPIED = 0, 100


def change_world(
    grid: OccupancyGrid,
    rng: Rng,
    *,
    moved: float = 0.0,
    removed: float = 0.0,
    added: float = 0.0,
    keep: ArrayLike = (),
    clearance: float = 0.35,
) -> OccupancyGrid:
    """Return the world at a later time than its map.

    Walls and furniture are cut into pieces of 1 m. The shares are of the surface: the occupied cells next to a
    free one.

    Args:
        grid: The map.
        rng: Random generator.
        moved: Share of the surface whose pieces move by 0.5 to 2 m, onto free cells, from 0 to 1.
        removed: Share of the surface whose pieces disappear, from 0 to 1.
        added: Surface of new boxes and round objects on free cells, as a share of the map's, at least 0.
        keep: (T, 2) or (T, 3) positions around which nothing new may stand [m].
        clearance: Distance from these positions that stays free [m].

    Returns:
        A grid of the same geometry with cells 0, 100 or unchanged.

    Raises:
        TypeError, ValueError: an argument has the wrong type or breaks its rule.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> grid = gs.worlds.building()
        >>> world = gs.worlds.change_world(grid, np.random.default_rng(0), moved=0.1)
        >>> bool((world.occupied != grid.occupied).any())
        True
    """
    checks.instance("grid", grid, OccupancyGrid)
    checks.instance("rng", rng, np.random.Generator)
    shares = [checks.real("moved", moved, low=0, high=1), checks.real("removed", removed, low=0, high=1)]
    new = checks.real("added", added, low=0)
    if sum(shares) > 1:
        raise ValueError(f"moved + removed: must be at most 1, got {sum(shares)}")
    cells, allowed = np.array(grid.cells), _allowed(grid, keep, clearance)
    surface = surface_of(grid)
    total = int(np.count_nonzero(surface))
    pieces = pieces_of(grid, surface, rng)
    gone, taken = [round(share * total) for share in shares], 0
    for piece in pieces:
        if taken >= sum(gone):
            break
        rows, cols = piece
        cells[rows, cols] = _FREE
        if taken < gone[0]:
            _move(cells, allowed, piece, grid.resolution, rng)
        taken += int(np.count_nonzero(surface[rows, cols]))
    _furnish(cells, allowed, grid.resolution, round(new * total), rng)
    return OccupancyGrid(cells, grid.resolution, grid.origin, occupied_threshold=grid.occupied_threshold)


def make_glass(grid: OccupancyGrid, share: float, rng: Rng) -> Flags:
    """Choose the (H, W) occupied cells through which beams pass: pieces of walls with this share of the surface."""
    glass, surface, taken = np.zeros(grid.shape, bool), surface_of(grid), 0
    wanted = round(checks.real("glass", share, low=0, high=1) * np.count_nonzero(surface))
    for rows, cols in pieces_of(grid, surface, rng):
        if taken >= wanted:
            break
        glass[rows, cols] = True
        taken += int(np.count_nonzero(surface[rows, cols]))
    return glass


def surface_of(grid: OccupancyGrid) -> Flags:
    """Return the (H, W) occupied cells with a free neighbour."""
    free = np.pad(grid.free, 1)
    near = free[:-2, 1:-1] | free[2:, 1:-1] | free[1:-1, :-2] | free[1:-1, 2:]
    surface: Flags = grid.occupied & near
    return surface


def pieces_of(grid: OccupancyGrid, surface: Flags, rng: Rng) -> list[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Return the rows and columns of the occupied cells in each tile of 1 m with a surface, in random order."""
    side = max(round(_PIECE / grid.resolution), 1)
    rows, cols = np.nonzero(grid.occupied)
    tile = rows // side * (grid.shape[1] // side + 1) + cols // side
    order = np.argsort(tile, kind="stable")
    ends = np.flatnonzero(np.diff(tile[order])) + 1
    pieces = [(rows[part], cols[part]) for part in np.split(order, ends) if len(part)]
    pieces = [piece for piece in pieces if surface[piece].any()]
    return [pieces[k] for k in rng.permutation(len(pieces))]


def _allowed(grid: OccupancyGrid, keep: ArrayLike, clearance: float) -> Flags:
    """Return the (H, W) free cells away from the positions to keep."""
    from scipy.ndimage import distance_transform_edt

    allowed = np.array(grid.free)
    poses = checks.as_array("keep", keep)
    if poses.size == 0:
        return allowed
    if poses.ndim != 2 or poses.shape[1] not in (2, 3):
        raise ValueError(f"keep: shape must be (T, 2) or (T, 3), got {checks.shape_text(poses.shape)}")
    places = checks.array("keep", poses)[:, :2]
    far = np.ones(grid.shape, bool)
    cols, rows = np.floor(grid.world_to_cells(places)).astype(np.int64).T
    inside = (rows >= 0) & (rows < grid.shape[0]) & (cols >= 0) & (cols < grid.shape[1])
    far[rows[inside], cols[inside]] = False
    if not far.all():
        allowed &= distance_transform_edt(far) * grid.resolution > clearance + grid.resolution
    return allowed


def _move(
    cells: NDArray[np.int8], allowed: Flags, piece: tuple[NDArray[np.intp], NDArray[np.intp]], side: float, rng: Rng
) -> None:
    """Draw a piece elsewhere with at least half of it on allowed cells, or nowhere if that fails."""
    for _ in range(_ATTEMPTS):
        length, angle = rng.uniform(_NEAREST, _FARTHEST) / side, rng.uniform(0, math.tau)
        rows = piece[0] + round(length * math.sin(angle))
        cols = piece[1] + round(length * math.cos(angle))
        inside = (rows >= 0) & (rows < cells.shape[0]) & (cols >= 0) & (cols < cells.shape[1])
        rows, cols = rows[inside], cols[inside]
        good = allowed[rows, cols]
        if 2 * np.count_nonzero(good) >= len(piece[0]):
            cells[rows[good], cols[good]] = _OCCUPIED
            return


def _furnish(cells: NDArray[np.int8], allowed: Flags, side: float, wanted: int, rng: Rng) -> None:
    """Draw boxes and discs on allowed cells until they have ``wanted`` surface cells."""
    rows, cols = np.nonzero(allowed)
    for _ in range(100 * wanted):
        if wanted <= 0 or len(rows) == 0:
            return
        k, half = rng.integers(len(rows)), rng.uniform(_SMALLEST, _LARGEST, 2) / side
        angle = rng.uniform(0, math.pi) if rng.random() < 0.7 else None
        drawn = _shape(cells.shape, (int(rows[k]), int(cols[k])), half, angle)
        if drawn[0].size and allowed[drawn].all() and (cells[drawn] != _OCCUPIED).all():
            cells[drawn] = _OCCUPIED
            box = 4 * (half[0] + half[1]) if angle is not None else math.tau * half[1]
            wanted -= max(round(box), 1)


def _shape(
    shape: tuple[int, ...], centre: tuple[int, int], half: NDArray[np.float64], angle: float | None
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return rows and columns of a rotated box, or of a disc if the angle is None; none if it leaves the grid."""
    reach = math.ceil(math.hypot(*half))
    v, u = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    if angle is None:
        inside = u * u + v * v <= max(half[1], 0.75) ** 2
    else:
        c, s = math.cos(angle), math.sin(angle)
        inside = (np.abs(c * u + s * v) <= half[0]) & (np.abs(c * v - s * u) <= half[1])
    rows, cols = centre[0] + v[inside], centre[1] + u[inside]
    if not rows.size or rows.min() < 0 or cols.min() < 0 or rows.max() >= shape[0] or cols.max() >= shape[1]:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    return rows, cols
