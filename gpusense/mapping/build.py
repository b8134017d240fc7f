"""Build occupancy grids from scans at known poses by the inverse sensor model and log-odds (book section 9.2)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense._util.memory import check_room
from gpusense.backends import Selection, get_backend
from gpusense.mapping.rays import SCANS, BandCounts, RayEnds, bands, batches, check_lengths, extent
from gpusense.world.deskew import check_motion
from gpusense.world.grid import GridFrame, OccupancyGrid, check_origin, check_resolution, grid_of_checked
from gpusense.world.scanner import Scanner, float64_readings
from gpusense.world.sensor_scans import check_scans
from gpusense.world.windows import LONGEST_SIDE, Window

BAND_CELLS = 1 << 22
"""Most cells of a band of rows that the device counts at once."""
# Most readings for keeping rays after the search for the map's extent.
_KEPT_RAYS = 1 << 20


def build_map(
    scans: ArrayLike,
    poses: ArrayLike,
    scanner: Scanner | Sequence[Scanner],
    *,
    sensor: ArrayLike | None = None,
    resolution: float = 0.05,
    origin: ArrayLike | None = None,
    shape: tuple[int, int] | None = None,
    range_limit: float | None = None,
    clear_max: bool = False,
    p_hit: float = 0.85,
    p_miss: float = 0.45,
    p_prior: float = 0.5,
    occupied_threshold: int = 65,
    motion: ArrayLike | None = None,
    backend: Selection = "auto",
) -> OccupancyGrid:
    """Build an occupancy grid from scans at known poses.

    Each ray adds ``log(p_miss / (1 - p_miss))`` to the log-odds of the cells that it crosses, and ``log(p_hit / (1 -
    p_hit))`` to the cell where it ends at an obstacle (*Probabilistic Robotics* tables 9.1 and 9.2, with an obstacle of
    one cell's thickness). The device counts hits and misses in integers by an exact walk from cell to cell, so that
    all backends build the same map. Cells without a ray are unknown. Rays may start or end far outside the map. Large
    maps are built in bands of rows, to need little more memory than the result, a byte a cell.

    Args:
        scans: (S, K) readings [m]; missing readings are ignored. A ray may span 524 288 cells along an axis. For
            several scanners, S readings of each scanner's length.
        poses: (S, 3) poses of the robot in the world [m, m, rad].
        scanner: The scanner's geometry, or several scanners.
        sensor: (S,) index of the scanner of each scan; only for several scanners.
        resolution: Side of a cell [m], 1e-4 to 1e3.
        origin: Pose (x, y, yaw) of the map's first corner [m, m, rad]; requires ``shape``. None fits the map to all
            rays, with an origin at a multiple of the resolution.
        shape: Rows and columns; requires ``origin``. Cells outside are ignored.
        range_limit: Longer ranges clear cells up to ``range_limit`` and mark no obstacle [m]. None:
            ``scanner.range_max``.
        clear_max: Whether max readings clear cells up to ``range_limit``. The default ignores them, since dark and
            oblique surfaces also return nothing.
        p_hit: Occupancy after one hit and an even prior, in (0.5, 1).
        p_miss: Occupancy after one miss and an even prior, in (0, 0.5).
        p_prior: Occupancy before any ray, in (0, 1).
        occupied_threshold: Least occupancy of an occupied cell [per cent].
        motion: (S, 3) motion of the robot during each scan, from odometry: its pose at the last beam in its frame at
            the first one [m, m, rad]. Beams are measured in order at equal intervals, and ``poses`` belong to the first
            beam. None: the robot is at rest.
        backend: The device, see :func:`gpusense.devices`.

    Returns:
        The map; occupancy is rounded to per cent.

    Raises:
        TypeError, ValueError: an argument is of the wrong kind or breaks its rule; the message names it.
        MemoryError: the map does not fit into memory.

    Example:
        >>> import gpusense as gs
        >>> scanner = gs.Scanner([0.0, 1.57], range_max=5.0)
        >>> grid = gs.build_map([[1.02, 5.0]], [(0.0, 0.0, 0.0)], scanner, resolution=0.25, backend="numpy")
        >>> grid.cells.tolist()
        [[-1, -1, -1, -1, -1, -1, -1], [-1, 45, 45, 45, 45, 85, -1], [-1, -1, -1, -1, -1, -1, -1]]
    """
    builder = MapBuilder(
        scans, poses, scanner, resolution=resolution, origin=origin, shape=shape, range_limit=range_limit,
        clear_max=clear_max, p_hit=p_hit, p_miss=p_miss, p_prior=p_prior, occupied_threshold=occupied_threshold,
        motion=motion, sensor=sensor, backend=backend,
    )  # fmt: skip
    for _ in builder.steps():
        pass
    return builder.grid()


class MapBuilder:
    """Incremental :func:`build_map`; the map so far can be read at any time.

    Counts take eight bytes a cell, the map itself one. Large maps are therefore built in bands of rows, each from all
    scans that meet it.
    """

    def __init__(
        self,
        scans: ArrayLike,
        poses: ArrayLike,
        scanner: Scanner | Sequence[Scanner],
        *,
        resolution: float,
        origin: ArrayLike | None,
        shape: tuple[int, int] | None,
        range_limit: float | None,
        clear_max: bool,
        p_hit: float,
        p_miss: float,
        p_prior: float,
        occupied_threshold: int,
        backend: Selection,
        motion: ArrayLike | None = None,
        sensor: ArrayLike | None = None,
        each: int = SCANS,
        most: int = BAND_CELLS,
    ) -> None:
        placed = checks.array("poses", poses, ("S", 3))
        data = check_scans(scans, scanner, sensor, _readings)
        if len(data) != len(placed):
            raise ValueError(f"scans: must be as many as poses, {len(placed)}, got {len(data)}")
        cell = check_resolution(resolution)
        limit = np.inf if range_limit is None else checks.real("range_limit", range_limit, above=0)
        checks.boolean("clear_max", clear_max)
        self._occupancy = (
            checks.real("p_hit", p_hit, above=0.5, below=1), checks.real("p_miss", p_miss, above=0, below=0.5),
            checks.real("p_prior", p_prior, above=0, below=1),
        )  # fmt: skip
        self._threshold = checks.integer("occupied_threshold", occupied_threshold, low=1, high=100)
        self._data, self._poses, self._limit, self._clear_max = data, placed, limit, clear_max
        self._motion = check_motion("motion", motion, len(placed))
        self._each, self._backend = each, get_backend(backend)
        self._place(cell, origin, shape)
        self._bands = bands(self._shape, most)
        self._counts: BandCounts | None = None
        self._rays = self._finished = 0
        check_room("shape", self._shape[0] * self._shape[1], f"{self._shape[0]} x {self._shape[1]} cells")
        self._cells = np.full(self._shape, -1, np.int8)

    def _place(self, resolution: float, origin: ArrayLike | None, shape: tuple[int, int] | None) -> None:
        """Choose the map's frame and shape, and find the rows that each scan's rays meet."""
        placed = _frame(origin, shape)
        # Until a frame is known, boxes are in metres.
        frame = GridFrame(1.0, (0.0, 0.0, 0.0)) if placed is None else GridFrame(resolution, placed[0])
        boxes = np.empty((len(self._poses), 4))
        few = sum(readings.size for readings in self._data.readings) <= _KEPT_RAYS
        self._kept: dict[bytes, RayEnds] = {}
        for part in batches(np.arange(len(boxes)), self._each):
            ends = self._rays_of(part)
            check_lengths(ends, resolution, int(part[0]))
            boxes[part] = ends.boxes(len(part), frame)
            if few:
                self._kept[part.tobytes()] = ends
        if placed is None:
            placed = extent(boxes, resolution)
            boxes = (boxes - np.tile(placed[0][:2], 2)) / resolution
        (origin, self._shape), self._rows = placed, boxes[:, [1, 3]]
        self._frame = GridFrame(resolution, check_origin(origin))

    def steps(self) -> Iterator[float]:
        """Count rays, some scans at a time, and yield the finished share of the work."""
        chosen = [batches(self._scans_of(band), self._each) for band in self._bands]
        total, done = max(sum(len(part) for parts in chosen for part in parts), 1), 0
        for band, parts in zip(self._bands, chosen, strict=True):
            self._counts = BandCounts(self._backend, self._frame, self._shape, band)
            for part in parts:
                key = part.tobytes()
                self._counts.add(self._kept.pop(key) if key in self._kept else self._rays_of(part))
                done += len(part)
                if done < total:
                    yield done / total
            self._counts.occupancies(self._cells, self._occupancy)
            self._rays, self._counts, self._finished = self._rays + self._counts.rays, None, self._finished + 1
        yield 1.0

    def _rays_of(self, chosen: np.ndarray) -> RayEnds:
        """Return the rays of the scans with these indices."""
        parts, sensor, place = [], self._data.sensor[chosen], self._data.places()[chosen]
        for one in np.unique(sensor):
            some = np.flatnonzero(sensor == one)
            scanner, rows = self._data.scanners[one], chosen[some]
            ends = RayEnds.of_scans(
                self._data.readings[one][place[some]], self._poses[rows], scanner,
                min(self._limit, scanner.range_max), clear_max=self._clear_max,
                motion=None if self._motion is None else self._motion[rows],
            )  # fmt: skip
            parts.append(ends._replace(scan=some[ends.scan]))
        return parts[0] if len(parts) == 1 else RayEnds.joined(parts)

    def _scans_of(self, band: Window) -> np.ndarray:
        """Return the indices of the scans with rays that meet a band."""
        low, high = self._rows.T
        return np.flatnonzero((high >= band.row - 1) & (low <= band.row + band.rows + 1))

    @property
    def rays(self) -> int:
        """Number of rays counted so far, without rays that miss the map."""
        return self._rays + (0 if self._counts is None else self._counts.rays)

    @property
    def parts(self) -> int:
        """Number of launches, each for some scans and a band."""
        return sum(-(-len(self._scans_of(band)) // self._each) for band in self._bands)

    @property
    def bands(self) -> int:
        """Number of bands, counted one after another; a map of a single band is complete after each step."""
        return len(self._bands)

    def grid(self) -> OccupancyGrid:
        """Return the map so far: the finished bands and the current one."""
        cells = self._cells
        if self._finished < len(self._bands):
            cells = cells.copy()
            if self._counts is not None:
                self._counts.occupancies(cells, self._occupancy)
        return grid_of_checked(cells, *self._frame, occupied_threshold=self._threshold)


def _readings(name: str, value: Any, scanner: Scanner) -> np.ndarray:
    read = float64_readings(checks.array(name, value, ("S", scanner.count), finite=False, dtype=None), scanner)
    scanner._first_scans.look_at(name, read)
    return read


def _frame(
    origin: ArrayLike | None, shape: tuple[int, int] | None
) -> tuple[tuple[float, float, float], tuple[int, int]] | None:
    """Return the map's origin and shape; None if the rays determine them."""
    if (origin is None) != (shape is None):
        missing, present = ("origin", "shape") if origin is None else ("shape", "origin")
        raise ValueError(f"{missing}: must be given with {present}, got None")
    if shape is None:
        return None
    rows, cols = checks.array("shape", shape, (2,), dtype=np.int64).tolist()
    for size in (rows, cols):
        checks.integer("shape", size, low=1, high=LONGEST_SIDE)
    return check_origin(origin), (rows, cols)
