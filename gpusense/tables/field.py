"""The likelihood field's table on a device: what each cell of a window holds, made at once or mended in a part."""

from __future__ import annotations

import math

import numpy as np

from gpusense.backends import Backend
from gpusense.backends.base import Buffer
from gpusense.interface.terms import log_weight
from gpusense.tables.distances import check_size, squared_distances
from gpusense.world.parameters import LikelihoodFieldParameters
from gpusense.world.windows import Region

# Cells around the window that hold what lies outside the grid.
RING = 2
# Longest table from squared distances to values; a larger cap is looked up on the host while preparing.
_LONGEST_TABLE = 1 << 22
# A part of a window that is larger than this share of it is not worth a table mended instead of made anew.
_LARGEST_MENDED = 0.5


class FieldTable:
    """Makes and mends the table of one model.

    Args:
        real: Precision.
        parameters: Weights, deviation and cap.
        resolution: The side of a cell [m].
        range_max: Longest range [m].
        outside: ``"free"`` or ``"occupied"``.
        compat: Whose cubes of densities the cells hold; None for log densities or distances.
        log_table: Whether cells hold log densities, not distances.
        flags: Those of the model's kernel, so that both are one program.
    """

    def __init__(
        self,
        real: np.dtype,
        parameters: LikelihoodFieldParameters,
        resolution: float,
        range_max: float,
        *,
        outside: str,
        compat: str | None,
        log_table: bool,
        flags: frozenset[str],
    ) -> None:
        self._real, self._parameters, self._resolution, self._range_max = real, parameters, resolution, range_max
        self._compat, self._log_table, self._flags = compat, log_table, flags
        # What lies outside the grid is an obstacle to the cells inside, or nothing to them.
        self._margin = RING if outside == "occupied" else 0
        beyond = self._values(np.array([0.0 if self._margin else np.inf]))
        if compat == "beluga" and not self._margin:
            beyond[:] = 1 / range_max**3
        self._beyond = beyond.astype(real)[0]
        self._density: np.ndarray | None = None

    def make(self, backend: Backend, window: np.ndarray) -> Buffer:
        """Padded table of a window; its ring holds what lies outside the grid."""
        rows, cols = window.shape
        check_size(rows, cols)
        density = self._density_of(rows, cols)
        margin = self._margin
        obstacles = _walled(window, margin, Region(0, 0, rows + 2 * margin, cols + 2 * margin))
        size = (rows + 2 * RING, cols + 2 * RING)
        if density is None:
            distances = backend.download(squared_distances(backend, obstacles), np.empty(obstacles.shape, np.int32))
            table = np.full(size, self._beyond)
            inside = slice(RING - margin, -(RING - margin) or None)
            table[inside, inside] = self._values(_with_infinity(distances))
            return backend.upload(table)
        table = backend.empty(size[0] * size[1], self._real)
        everything = Region(margin - RING, margin - RING, *size)
        self._fill(backend, obstacles, density, table, everything, 0, size[1])
        return table

    def mend(self, backend: Backend, window: np.ndarray, table: Buffer, changed: Region) -> bool:
        """Fill the part of a window's table whose capped distances can be others; False where that does not pay."""
        rows, cols = window.shape
        density = self._density_of(rows, cols)
        if density is None:
            return False
        margin, reach = self._margin, math.isqrt(len(density) - 2)
        shape = (rows + 2 * margin, cols + 2 * margin)
        part = changed.moved(margin, margin).grown(reach, shape)
        around = part.grown(reach, shape)
        if around.cells > _LARGEST_MENDED * window.size:
            return False
        stride, corner = cols + 2 * RING, part.moved(RING - margin, RING - margin)
        self._fill(
            backend, _walled(window, margin, around), density, table, part.moved(-around.row, -around.col),
            corner.row * stride + corner.col, stride,
        )  # fmt: skip
        return True

    def _values(self, squared: np.ndarray) -> np.ndarray:
        """What the table holds for squared cell distances: log densities, or distances in metres. float64."""
        p = self._parameters
        distance = np.minimum(np.sqrt(squared) * self._resolution, p.max_distance)
        if self._compat is not None:
            return self._cubes(distance)
        return self._log_density(distance) if self._log_table else distance

    def _cubes(self, distance: np.ndarray) -> np.ndarray:
        """What the peer sums: the cube of its density at a distance."""
        p, amcl = self._parameters, self._compat == "amcl"
        hit = p.z_hit if amcl else p.z_hit / (p.sigma_hit * math.sqrt(2 * math.pi))
        density = hit * np.exp(-0.5 * (distance / p.sigma_hit) ** 2) + p.z_rand / self._range_max
        return np.asarray(density**3)

    def _log_density(self, distance: np.ndarray) -> np.ndarray:
        p = self._parameters
        with np.errstate(over="ignore"):
            exponent = 0.5 * (distance / p.sigma_hit) ** 2
        log_hit = log_weight(p.z_hit) - math.log(p.sigma_hit) - 0.5 * math.log(2 * math.pi) - exponent
        return np.logaddexp(log_hit, log_weight(p.z_rand) - math.log(self._range_max))

    def _density_of(self, rows: int, cols: int) -> np.ndarray | None:
        """Values of the squared distances 0, 1, ... and infinity; None where they are too many.

        They are as many as a map of this size can have, or as the cap lets count.
        """
        reach, diagonal = self._parameters.max_distance / self._resolution, rows * rows + cols * cols
        farthest = diagonal if reach * reach >= diagonal else math.floor(reach * reach) + 1
        if farthest > _LONGEST_TABLE:
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
        part: Region,
        begin: int,
        stride: int,
    ) -> None:
        """Fill a part of a table, of which a place comes first, from obstacles that hold all within the cap of it."""
        cap = len(density) - 1
        squared = squared_distances(backend, obstacles, cap - 1)
        backend.compile("fill_field", self._flags)(
            (part.cols, part.rows), squared, backend.upload(density), table, *obstacles.shape, cap, self._beyond,
            part.col, part.row, part.cols, part.rows, begin, stride,
        )  # fmt: skip
        backend.synchronize()


def _walled(window: np.ndarray, margin: int, part: Region) -> np.ndarray:
    """A part of a window with a margin of obstacles around it, where (0, 0) is the margin's corner."""
    if margin == 0:
        return part.cut(window)
    walled = np.ones((part.rows, part.cols), bool)
    inside = part.shared(Region(margin, margin, *window.shape))
    if inside is not None:
        inside.moved(-part.row, -part.col).cut(walled)[...] = inside.moved(-margin, -margin).cut(window)
    return walled


def _with_infinity(squared: np.ndarray) -> np.ndarray:
    """Squared distances as float64, infinite where there is no obstacle."""
    return np.where(squared == np.iinfo(np.int32).max, np.inf, squared.astype(np.float64))
