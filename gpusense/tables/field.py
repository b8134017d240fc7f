"""Compute the likelihood field's table on a device: a value per cell of a window, made or partly refreshed."""

from __future__ import annotations

import math

import numpy as np

from gpusense.backends import Backend
from gpusense.backends.base import Buffer
from gpusense.interface.launches import launch
from gpusense.peers.weights import OVERLAID, Beluga, Peer
from gpusense.tables.distances import NO_OBSTACLE, check_size, squared_distances, squared_of_stack
from gpusense.tables.world_cells import Stack, Table
from gpusense.tables.worlds import Worlds
from gpusense.world.field_density import FieldDensity
from gpusense.world.likelihood import Likelihood
from gpusense.world.parameters import LikelihoodFieldParameters
from gpusense.world.windows import Window

# Width of the ring of cells around the window that represents space outside the grid [cells].
RING = 2
# Most entries of the table from squared distances to values; beyond, the host computes values.
_LONGEST_DENSITY = 1 << 22
# Largest share of a window's cells to refresh; a larger change rebuilds the table.
_LARGEST_REFRESH = 0.5


class FieldTable:
    """Table of a likelihood field model.

    ``log_table``: whether cells hold terms of the sum instead of distances [m]; ``flags``: flags of the model's kernel,
    to share a program.
    """

    def __init__(
        self,
        real: np.dtype,
        parameters: LikelihoodFieldParameters,
        resolution: float,
        range_max: float,
        *,
        outside: str,
        weights: Likelihood,
        log_table: bool,
        flags: frozenset[str],
    ) -> None:
        self._real, self._parameters, self._resolution, self._range_max = real, parameters, resolution, range_max
        self._log_table, self._flags = log_table, flags
        self._peer = weights if isinstance(weights, Peer) else None
        # Term of cells with a fixed density.
        self._overlay: float | None = None
        if isinstance(weights, Beluga) and weights.overlaid:
            self._overlay = float(weights.terms(weights.overlay(parameters, range_max)))
        # Space outside the grid is an obstacle for the cells inside, or has no effect.
        self._margin = RING if outside == "occupied" else 0
        outside_value = self._values(np.array([0.0 if self._margin else np.inf]))
        if self._peer is not None and not self._margin:
            outside_value = self._peer.terms(np.array([self._peer.beyond(parameters, range_max)]))
        self._outside_value = outside_value.astype(real)[0]
        self._density: np.ndarray | None = None

    def make(self, backend: Backend, obstacles: np.ndarray) -> Buffer:
        """Make the padded table of a window from its (rows, cols) mask; the ring represents space outside."""
        rows, cols = obstacles.shape
        check_size(rows, cols)
        overlaid = None if self._overlay is None else obstacles == OVERLAID
        obstacles = obstacles if overlaid is None else obstacles == 1
        density = None if overlaid is not None else self._density_of(rows, cols)
        margin = self._margin
        walled = _walled(obstacles, margin, Window(0, 0, rows + 2 * margin, cols + 2 * margin))
        size = (rows + 2 * RING, cols + 2 * RING)
        if density is None:
            squared = backend.download(squared_distances(backend, walled), np.empty(walled.shape, np.int32))
            table = np.full(size, self._outside_value)
            inside = slice(RING - margin, -(RING - margin) or None)
            table[inside, inside] = self._values(np.where(squared == NO_OBSTACLE, np.inf, squared.astype(np.float64)))
            if overlaid is not None:
                table[RING:-RING, RING:-RING][overlaid] = self._overlay
            return backend.upload(table)
        table = backend.empty(size[0] * size[1], self._real)
        everything = Window(margin - RING, margin - RING, *size)
        self._fill(backend, walled, density, table, everything, 0, size[1])
        return table

    def of_worlds(self, worlds: Worlds, unknown: str) -> Buffer:
        """Return the tables of all worlds, made on the device; models of the same parameters share them."""
        margin = self._margin

        def fill(stack: Stack, table: Buffer) -> None:
            density = self._density_of(stack.rows, stack.cols)
            if density is None:
                rule = f"must be at most {math.isqrt(_LONGEST_DENSITY) - 1} cells in Worlds of this size"
                raise ValueError(f"max_distance: {rule}, got {self._parameters.max_distance} m")
            backend, cap = worlds.backend, len(density) - 1
            marked, shape = worlds.marked(stack, unknown, margin)
            squared = squared_of_stack(backend, stack.space, marked, shape, stack.worlds, cap - 1)
            size = (stack.cols + 2 * RING, (stack.rows + 2 * RING) * stack.worlds)
            backend.run((
                launch(
                    "fill_worlds", self._flags & {"FLOAT64"}, size, squared=squared, density=backend.upload(density),
                    place=stack.place, table=table, rows=stack.rows, cols=stack.cols, worlds=stack.worlds,
                    margin=margin, cap=cap, beyond=self._outside_value.item(),
                ),
            ))  # fmt: skip

        def make() -> Table:
            return Table(worlds.allocate(1, self._real), self._real.itemsize * worlds.cells, fill)

        key = ("field", self._parameters, self._range_max, self._margin, unknown, self._log_table, self._real)
        return worlds.table(key, make).buffer

    def refresh(self, backend: Backend, obstacles: np.ndarray, table: Buffer, changed: Window) -> bool:
        """Update a table in place after obstacles of a window changed; return False if rebuilding it is faster."""
        rows, cols = obstacles.shape
        density = None if self._overlay is not None else self._density_of(rows, cols)
        if density is None:
            return False
        margin, reach = self._margin, math.isqrt(len(density) - 2)
        shape = (rows + 2 * margin, cols + 2 * margin)
        part = changed.moved(margin, margin).grown(reach, shape)
        around = part.grown(reach, shape)
        if around.cells > _LARGEST_REFRESH * obstacles.size:
            return False
        stride, corner = cols + 2 * RING, part.moved(RING - margin, RING - margin)
        self._fill(
            backend, _walled(obstacles, margin, around), density, table, part.moved(-around.row, -around.col),
            corner.row * stride + corner.col, stride,
        )  # fmt: skip
        return True

    def _values(self, squared: np.ndarray) -> np.ndarray:
        """Convert squared distances [cells^2] to float64 cell values: log densities, distances [m], peers' terms."""
        p = self._parameters
        if self._peer is not None:
            return self._peer.terms(self._peer.field_values(squared, p, self._resolution, self._range_max))
        density = FieldDensity(p, self._range_max)
        distance = density.capped(np.sqrt(squared) * self._resolution)
        return density.log(distance) if self._log_table else np.minimum(distance, np.finfo(self._real).max)

    def _density_of(self, rows: int, cols: int) -> np.ndarray | None:
        """Return the cell values of the squared distances 0, 1, ... and infinity; None if there are too many.

        The largest squared distance is the square of the map's diagonal or of ``max_distance``, whichever is smaller.
        """
        reach, diagonal = self._parameters.max_distance / self._resolution, rows * rows + cols * cols
        farthest = diagonal if reach * reach >= diagonal else math.floor(reach * reach) + 1
        if farthest > _LONGEST_DENSITY:
            return None
        if self._density is None or len(self._density) != farthest + 2:
            counted = np.append(np.arange(farthest + 1, dtype=np.float64), np.inf)
            self._density = self._values(counted).astype(self._real)
        return self._density

    def _fill(
        self,
        backend: Backend,
        obstacles: np.ndarray,
        density: np.ndarray,
        table: Buffer,
        part: Window,
        begin: int,
        stride: int,
    ) -> None:
        """Fill a part of a table from (rows, cols) obstacles, all within the clamp distance of the part."""
        cap = len(density) - 1
        squared = squared_distances(backend, obstacles, cap - 1)
        backend.compile("fill_field", self._flags)(
            (part.cols, part.rows), squared, backend.upload(density), table, *obstacles.shape, cap, self._outside_value,
            part.col, part.row, part.cols, part.rows, begin, stride,
        )  # fmt: skip
        backend.synchronize()


def _walled(obstacles: np.ndarray, margin: int, part: Window) -> np.ndarray:
    """Cut a part out of a window with a margin of obstacles; (0, 0) of ``part`` is the margin's corner."""
    if margin == 0:
        return part.cut(obstacles)
    walled = np.ones((part.rows, part.cols), bool)
    inside = part.shared(Window(margin, margin, *obstacles.shape))
    if inside is not None:
        inside.moved(-part.row, -part.col).cut(walled)[...] = inside.moved(-margin, -margin).cut(obstacles)
    return walled
