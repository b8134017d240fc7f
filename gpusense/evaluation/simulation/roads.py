"""Plan paths of a robot through the free space of a map."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gpusense._util.typing import Flags, Floats
from gpusense.world.grid import OccupancyGrid

Rng = np.random.Generator
# Distance between nodes of the lattice [m]; half side of the window around the start to which a larger map is cut [m].
_SPACING, _HALF_WINDOW, _MOST_NODES = 0.1, 30.0, 300_000


class Roads:
    """Shortest paths between random places of one connected part of the free space.

    Args:
        grid: The map; paths are in its frame.
        free: (H, W) cells where the robot may be.
        clearance: Least distance of a path from every other cell, and from the grid's edge [m].
        rng: Random generator, which chooses a part with probability proportional to the number of its nodes.
    """

    def __init__(self, grid: OccupancyGrid, free: Flags, clearance: float, rng: Rng) -> None:
        from scipy.ndimage import distance_transform_edt, label

        wanted = clearance / grid.resolution + math.sqrt(0.5)
        self._grid = grid
        self._open: Flags = distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1] >= wanted
        self._stride = max(round(_SPACING / grid.resolution), 1)
        nodes = self._open[:: self._stride, :: self._stride]
        parts, _ = label(nodes)
        inside = np.flatnonzero(nodes.ravel())
        if len(inside) == 0:
            raise ValueError(f"clearance: must be found somewhere in the map, got {clearance}")
        first = int(rng.choice(inside))
        chosen = parts == parts.ravel()[first]
        if np.count_nonzero(chosen) > _MOST_NODES:
            row, col = divmod(first, nodes.shape[1])
            reach = math.ceil(_HALF_WINDOW / (self._stride * grid.resolution))
            window = np.zeros_like(chosen)
            window[max(row - reach, 0) : row + reach + 1, max(col - reach, 0) : col + reach + 1] = True
            near, _ = label(chosen & window)
            chosen = near == near.ravel()[first]
        self._width = nodes.shape[1]
        self.nodes = np.flatnonzero(chosen.ravel())
        if len(self.nodes) < 2:
            raise ValueError(f"clearance: must leave the robot room to move in the map, got {clearance}")
        self._graph = _graph_of(chosen, self.nodes)

    def random_node(self, rng: Rng) -> int:
        """Draw the index of a node."""
        return int(rng.integers(len(self.nodes)))

    def path(self, start: int, goal: int) -> Floats:
        """Return the (P, 2) corners of a short path between two nodes, both included, in the world [m]."""
        from scipy.sparse.csgraph import dijkstra

        _, before = dijkstra(self._graph, indices=goal, return_predecessors=True)
        chain = [start]
        while chain[-1] != goal:
            chain.append(int(before[chain[-1]]))
        rows, cols = np.divmod(self.nodes[chain], self._width)
        cells = np.stack([rows, cols], axis=1) * self._stride
        corners = self._straightened(cells)
        return self._grid.cell_centers(corners[:, 0], corners[:, 1])

    def wander(self, length: float, rng: Rng) -> Floats:
        """Return the (P, 2) corners of a path of at least this length between random nodes [m]."""
        node = self.random_node(rng)
        parts, driven = [self.path(node, node)], 0.0
        while driven < length:
            goal = self.random_node(rng)
            leg = self.path(node, goal)
            driven += float(np.hypot(*np.diff(leg, axis=0).T).sum())
            parts.append(leg[1:])
            node = goal
        return np.concatenate(parts)

    def _straightened(self, cells: NDArray[np.intp]) -> NDArray[np.intp]:
        """Shorten a path: each corner moves along to the last point in sight of the previous corner."""
        kept, last = [0], len(cells) - 1
        while kept[-1] < last:
            one = kept[-1]
            far = one + 1
            while far < last and self._sees(cells[one], cells[far + 1]):
                far += 1
            kept.append(far)
        return cells[kept]

    def _sees(self, one: NDArray[np.intp], other: NDArray[np.intp]) -> bool:
        """Return whether the segment between two cells is open."""
        count = 2 * int(np.abs(other - one).max()) + 1
        along = one + np.linspace(0, 1, count)[:, None] * (other - one)
        rows, cols = np.rint(along).astype(np.intp).T
        return bool(self._open[rows, cols].all())


def _graph_of(chosen: Flags, nodes: NDArray[np.intp]) -> object:
    """Return the sparse matrix of distances between neighbouring nodes, diagonals included."""
    from scipy.sparse import csr_matrix

    flat = np.full(chosen.size, -1)
    flat[nodes] = np.arange(len(nodes))
    index = flat.reshape(chosen.shape)
    pairs, lengths = [], []
    for (a, b), length in (
        ((index[:, :-1], index[:, 1:]), 1.0),
        ((index[:-1], index[1:]), 1.0),
        ((index[:-1, :-1], index[1:, 1:]), math.sqrt(2)),
        ((index[:-1, 1:], index[1:, :-1]), math.sqrt(2)),
    ):
        both = (a >= 0) & (b >= 0)
        pairs.append(np.stack([a[both], b[both]]))
        lengths.append(np.full(np.count_nonzero(both), length))
    i, j = np.concatenate(pairs, axis=1)
    shape = (len(nodes), len(nodes))
    return csr_matrix(
        (np.tile(np.concatenate(lengths), 2), (np.concatenate([i, j]), np.concatenate([j, i]))), shape=shape
    )


def drive(corners: Floats, heading: float, step: float, turn: float, most: int) -> Floats:
    """Return the poses of a robot that turns on the spot at each corner and drives straight between corners.

    ``corners``: (P, 2) corners of the path, the first one the start [m]. ``heading``: Heading at the start [rad].
    ``step``: Distance between two scans [m]. ``turn``: Largest turn between two scans [rad].

    Returns:
        (T, 3) poses after the start, at most ``most``.
    """
    x, y = corners[0].tolist()
    poses: list[tuple[float, float, float]] = []
    left = 1.0
    for gx, gy in corners[1:].tolist():
        while len(poses) < most:
            length = math.hypot(gx - x, gy - y)
            if length < 1e-9:
                break
            error = math.remainder(math.atan2(gy - y, gx - x) - heading, math.tau)
            if abs(error) > 1e-9:
                share = min(abs(error) / turn, left)
                heading += math.copysign(share * turn, error) if share < abs(error) / turn else error
            else:
                share = min(length / step, left)
                x, y = x + (gx - x) * share * step / length, y + (gy - y) * share * step / length
            left -= share
            if left < 1e-9:
                poses.append((x, y, math.remainder(heading, math.tau)))
                left = 1.0
    return np.array(poses).reshape(-1, 3)
