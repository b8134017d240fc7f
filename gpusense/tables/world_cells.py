"""Checks of the arguments of ``Worlds``, and worlds of one size whose tables are made together."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from gpusense._util import checks
from gpusense.backends import Backend, arrays
from gpusense.backends.base import Buffer
from gpusense.backends.workspace import Workspace
from gpusense.world.frames import PlainCells, frame_of
from gpusense.world.grid import OccupancyGrid, check_origin
from gpusense.world.windows import LONGEST_SIDE


def are_grids(cells: Any) -> bool:
    """Tell whether cells are a list with a grid."""
    return isinstance(cells, (list, tuple)) and any(isinstance(one, OccupancyGrid) for one in cells)


def of_grids(
    grids: Sequence[Any], resolution: float | None, origin: Any, threshold: int | None
) -> tuple[float, Any, int]:
    """Return the resolution, the origins and the threshold of a list of grids."""
    for number, grid in enumerate(grids):
        checks.instance(f"cells[{number}]", grid, OccupancyGrid)
    sides = sorted({grid.resolution for grid in grids} | ({resolution} if resolution is not None else set()))
    if len(sides) > 1:
        raise ValueError(f"resolution: must be the same for all worlds, got {sides}")
    thresholds = sorted({grid.occupied_threshold for grid in grids} | ({threshold} if threshold is not None else set()))
    if len(thresholds) > 1:
        raise ValueError(f"occupied_threshold: must be the same for all worlds, got {thresholds}")
    return sides[0], [grid.origin for grid in grids] if origin is None else origin, thresholds[0]


def checked_cells(cells: Any, backend: Backend, name: str) -> tuple[Any, np.ndarray]:
    """Return (M, H, W) int8 cells, an array on the device or a list of cells of several sizes, and (M, 2) sizes."""
    if arrays.on_device(cells):
        adopted = arrays.adopt_integers(cells, backend, name, ("int8",))
        shape = adopted.shape
        if len(shape) != 3 or math.prod(shape) == 0:
            raise ValueError(f"{name}: shape must be (M, H, W) with a cell at least, got {checks.shape_text(shape)}")
        _check_side(name, shape[1:])
        return adopted, np.tile(shape[1:], (shape[0], 1))
    if isinstance(cells, (list, tuple)) and len(cells):
        each = [OccupancyGrid(arrays.to_host(one, f"{name}[{number}]"), 1.0).cells for number, one in enumerate(cells)]  # type: ignore[arg-type]
        for one in each:
            _check_side(name, one.shape)
        sizes = np.array([one.shape for one in each])
        return (np.stack(each) if (sizes == sizes[0]).all() else each), sizes
    values = checks.as_array(name, arrays.to_host(cells, name))
    if values.ndim != 3 or values.size == 0:
        raise ValueError(f"{name}: shape must be (M, H, W) with a cell at least, got {checks.shape_text(values.shape)}")
    _check_side(name, values.shape[1:])
    flat = OccupancyGrid(values.reshape(-1, values.shape[2]), 1.0).cells
    return flat.reshape(values.shape), np.tile(values.shape[1:], (len(values), 1))


def _check_side(name: str, shape: tuple[int, ...]) -> None:
    """Refuse worlds with sides that distances in 32 bits do not allow."""
    if max(shape) > LONGEST_SIDE:
        size = f"{shape[0]} x {shape[1]}"
        raise ValueError(f"{name}: a world must have at most {LONGEST_SIDE} rows and columns, got {size}")


def checked_origins(origin: Any, count: int) -> list[tuple[float, float, float]]:
    """Return the pose of each world's corner."""
    if origin is None:
        return [(0.0, 0.0, 0.0)] * count
    values = checks.as_array("origin", origin)
    if values.ndim == 2:
        poses = checks.array("origin", values, (count, 3))
        return [check_origin(pose) for pose in poses]
    return [check_origin(values)] * count


def frames_of(
    origins: Sequence[tuple[float, float, float]], resolution: float, sizes: np.ndarray, place: np.ndarray
) -> np.ndarray:
    """Return the frames (M, 8) of worlds; ``place`` (M,) is the first cell of each; see the file ``placement``."""
    frames = np.zeros((len(origins), 8))
    known: dict[tuple[float, float, float], tuple[float, ...]] = {}
    for number, origin in enumerate(origins):
        if origin not in known:
            frame = frame_of(PlainCells(origin, resolution, (1, 1)), (0.0, 0.0, 0.0))
            known[origin] = (frame.origin_x, frame.origin_y, frame.yaw_cos, frame.yaw_sin)
        frames[number, :4] = known[origin]
    frames[:, 4:6], frames[:, 6] = sizes, place
    return frames


class Stack(NamedTuple):
    """Some worlds of one size whose tables are made together."""

    indices: np.ndarray  # (W,) indices of the worlds
    rows: int  # rows of each
    cols: int  # columns of each
    place: Buffer  # first cell of each in tables with a ring, on the device
    space: Workspace  # memory besides the tables

    @property
    def worlds(self) -> int:
        """W."""
        return len(self.indices)


class Table(NamedTuple):
    """A table of all worlds."""

    buffer: Buffer  # the table
    size: int  # its size [bytes]
    fill: Callable[[Stack, Buffer], None]  # function that fills the parts of a stack of worlds
