"""Count hits and misses of cells on a device, and compute the occupancies."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import numpy as np

from gpusense.backends import Backend
from gpusense.backends.workspace import Workspace
from gpusense.interface.launches import launch
from gpusense.mapping.rays import CellRays, RayEnds
from gpusense.world.grid_frame import GridFrame
from gpusense.world.windows import Window

_INT = np.dtype(np.int32)
# Number of cells that the host processes at once.
_CHUNK = 1 << 20
# Occupancies of lower counts are tabulated.
_FEW = 256
# Larger log-odds also round to 0 or 100 per cent.
_LARGEST_ODDS = 40.0


def bands(shape: tuple[int, int], most: int) -> list[Window]:
    """Return the bands of rows of a map, each of at most ``most`` cells or a single row."""
    rows, cols = shape
    count = -(-rows // max(most // cols, 1))
    edges = [rows * i // count for i in range(count + 1)]
    return [Window(first, 0, last - first, cols) for first, last in itertools.pairwise(edges)]


class BandCounts:
    """Hits and misses of a band's cells on a device; ``rays`` end in the band, or in its rows outside the map."""

    def __init__(self, backend: Backend, frame: GridFrame, shape: tuple[int, int], band: Window) -> None:
        self._backend, self._frame, self._shape, self._band = backend, frame, shape, band
        self._space = Workspace(backend)
        self._hits = backend.empty(band.cells, _INT, zero=True)
        self._misses = backend.empty(band.cells, _INT, zero=True)
        self.rays = 0

    def add(self, ends: RayEnds) -> None:
        """Count the cells of rays."""
        rays = CellRays(ends, self._frame, self._band, self._shape)
        self.rays += rays.ending
        count = len(rays.hit)
        if count == 0:
            return
        names = ("start_cell", "start_inside", "end_cell", "end_inside", "hit")
        with self._space as space:
            placed = {name: space.upload(name, getattr(rays, name)) for name in names}
            one = launch(
                "count_rays", (), (count,), **placed, hits=self._hits, misses=self._misses, rows=self._band.rows,
                cols=self._band.cols, rays=count,
            )  # fmt: skip
            self._backend.run((one,))
            space.wait()

    def _counts(self) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
        """Yield the hits and misses of the band's cells in pieces, row by row."""
        cells, backend = self._band.cells, self._backend
        for first in range(0, cells, _CHUNK):
            size = min(_CHUNK, cells - first)
            hits, misses = (
                backend.download(backend.part(each, first, size, _INT), np.empty(size, _INT))
                for each in (self._hits, self._misses)
            )
            yield slice(first, first + size), hits, misses

    def occupancies(self, out: np.ndarray, model: tuple[float, float, float]) -> None:
        """Write the occupancies of the band into the (H, W) int8 cells of the map.

        Cells without a ray keep their value. ``model`` is the occupancy of a cell after one hit and an even prior,
        after one miss, and before any ray.
        """
        flat = self._band.cut(out).reshape(-1)
        few = np.arange(_FEW, dtype=_INT)
        table = _per_cent(np.repeat(few, _FEW), np.tile(few, _FEW), model)
        for part, hits, misses in self._counts():
            seen = np.flatnonzero(hits | misses)
            if len(seen) == 0:
                continue
            hits, misses = hits[seen], misses[seen]
            values = table.take(hits * _FEW + misses, mode="clip")
            many = np.flatnonzero((hits >= _FEW) | (misses >= _FEW))
            values[many] = _per_cent(hits[many], misses[many], model)
            flat[part][seen] = values


def _per_cent(hits: np.ndarray, misses: np.ndarray, model: tuple[float, float, float]) -> np.ndarray:
    """Return the int8 occupancy of cells with these counts by the sum of their log-odds."""
    hit, miss, prior = map(log_odds, model)
    odds = hits * hit + misses * miss + prior
    return np.rint(100 / (1 + np.exp(-np.clip(odds, -_LARGEST_ODDS, _LARGEST_ODDS)))).astype(np.int8)


def log_odds(p: float) -> float:
    """Return the log-odds of a probability."""
    return math.log(p / (1 - p))
