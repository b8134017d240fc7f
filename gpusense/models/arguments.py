"""Checks of arguments against each other: map and range, precision and device, tables and options."""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, Self, cast

import numpy as np

from gpusense._util import checks
from gpusense._util.typing import Precision
from gpusense.backends import Backend, BackendInfo, Selection
from gpusense.tables.worlds import Worlds
from gpusense.world.grid import OccupancyGrid
from gpusense.world.plausible import look_at_scene
from gpusense.world.scanner import Scanner
from gpusense.world.sensor_parameters import SensorTable

# Up to this number of cells float32 resolves the position of a crossing to 5/16 of a cell. From half a cell on,
# neighbouring boundaries could be confused.
_MOST_CELLS_PER_RANGE = 1 << 20


def check_scene(grid: object, range_max: float) -> OccupancyGrid | Worlds:
    """Return the map, after a check of its cells against the range."""
    checked = grid if isinstance(grid, Worlds) else checks.instance("grid", grid, OccupancyGrid)
    look_at_scene(range_max, math.hypot(checked.width, checked.height))
    cells = range_max / checked.resolution
    if cells > _MOST_CELLS_PER_RANGE:
        raise ValueError(f"range_max: must be at most {_MOST_CELLS_PER_RANGE} cells of the grid, got {cells:.15g}")
    return checked


def map_words(grid: OccupancyGrid | Worlds) -> str:
    """Return the size and the resolution of a map, as ``repr`` of models shows them."""
    rows, cols = grid.shape
    if isinstance(grid, Worlds):
        size = f"{rows} x {cols}" if (grid.sizes == grid.sizes[0]).all() else f"up to {rows} x {cols}"
        return f"{len(grid)} worlds of {size} cells, resolution={grid.resolution}"
    return f"{rows} x {cols} cells, resolution={grid.resolution}"


def real_dtype(precision: str, backend: Backend) -> np.dtype:
    """Return the NumPy dtype of a precision on a device."""
    dtype = np.dtype(checks.choice("precision", precision, ("float32", "float64")))
    if dtype == np.float64 and not backend.info.float64:
        raise ValueError(f"precision: must be 'float32' on {backend.info.name}, which has no float64, got 'float64'")
    return dtype


def check_absent(where: str, **options: object) -> None:
    """Refuse options that must be None (``where``: when they must be, in words of the message)."""
    for name, value in options.items():
        if value is not None:
            raise ValueError(f"{name}: must be None {where}, got {checks.show(value)}")


def check_discrete(model: SensorTable, scanner: Scanner, compat: object, sensor_table: object) -> None:
    """Refuse options that contradict a discrete model."""
    check_absent("with a DiscreteBeamModel", compat=compat, sensor_table=sensor_table)
    if isinstance(scanner, Scanner) and scanner.range_max != model.range_max:
        rule = f"must have the scanner's range_max = {scanner.range_max}"
        raise ValueError(f"parameters: {rule}, got a DiscreteBeamModel for {model.range_max}")


# ---- copies and pickles of models: the constructor's arguments, without any state of a device


class Pickled(ABC):
    """Base of objects whose copies and pickles call the constructor again.

    A pickle keeps the constructor's selection string, so "auto" may choose another device on another machine. A queue
    is replaced by the selection string of its device. A copy is on the same device.
    """

    _selection: Selection
    _backend: Backend
    _real: np.dtype

    def __repr__(self) -> str:
        parts = (*self._options(), f"precision={self.precision!r}", f"backend={self.device.selection!r}")
        return f"{type(self).__name__}({', '.join(parts)})"

    @property
    def backend(self) -> Backend:
        """The backend that holds the buffers."""
        return self._backend

    @property
    def device(self) -> BackendInfo:
        """The device for which the kernels are compiled."""
        return self._backend.info

    @property
    def precision(self) -> Precision:
        """``"float32"`` or ``"float64"``."""
        return cast(Precision, self._real.name)

    def _options(self) -> tuple[str, ...]:
        """Return the map and the options, except precision and backend, as ``repr`` shows them."""
        return ()

    @abstractmethod
    def _arguments(self) -> dict[str, Any]:
        """Return the arguments of the constructor except ``backend`` by name, with the current map."""

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        asked = self._selection if isinstance(self._selection, str) else self.backend.info.selection
        return _made, (type(self), self._arguments(), asked)

    def __copy__(self) -> Self:
        make: Any = type(self)
        return cast(Self, make(**self._arguments(), backend=self.backend))

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        make: Any = type(self)
        made = memo[id(self)] = make(**copy.deepcopy(self._arguments(), memo), backend=self.backend)
        return cast(Self, made)


def _made(kind: Any, arguments: dict[str, Any], backend: str) -> Any:
    """Make an object of a class from a pickle."""
    return kind(**arguments, backend=backend)
