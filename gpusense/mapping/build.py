"""Occupancy grids from scans at known poses, by the inverse sensor model and log-odds (book section 9.2)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense.backends import Selection, get_backend
from gpusense.mapping.counts import SCANS, RayCounts, RayEnds, batches, extent
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Scanner
from gpusense.world.sweep import check_motion
from gpusense.world.windows import LONGEST_SIDE


def build_map(
    scans: ArrayLike,
    poses: ArrayLike,
    scanner: Scanner,
    *,
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
    one cell's thickness). The device counts hits and misses in integers by an exact walk from cell to cell, so all
    backends build the same map. Cells without a ray are unknown.

    Args:
        scans: (S, K) readings [m]; missing readings say nothing.
        poses: (S, 3) poses of the robot in the world [m, m, rad].
        scanner: The scanner's geometry.
        resolution: Side of a cell [m], > 0.
        origin: Pose (x, y, yaw) of the map's first corner [m, m, rad]; requires ``shape``. None: the map holds all
            rays, and its origin is a multiple of the resolution.
        shape: Rows and columns; requires ``origin``. Cells of rays outside are left out.
        range_limit: Ranges beyond it clear cells up to it and mark no obstacle [m]. None: ``scanner.range_max``.
        clear_max: Whether max readings clear cells up to ``range_limit``. By default they say nothing, since dark and
            oblique surfaces return nothing, either.
        p_hit: Occupancy after one hit and an even prior, in (0.5, 1).
        p_miss: Occupancy after one miss and an even prior, in (0, 0.5).
        p_prior: Occupancy before any ray, in (0, 1).
        occupied_threshold: Least occupancy of an occupied cell [per cent].
        motion: (S, 3) motion of the robot during each scan, from odometry: its pose at the last beam in its frame at
            the first one [m, m, rad]. Beams are measured in their order, evenly in time, and ``poses`` are those at
            the first beam. None: the robot is at rest.
        backend: The device, see :func:`gpusense.devices`.

    Returns:
        The map; occupancy is rounded to per cent.

    Raises:
        TypeError, ValueError: an argument is of the wrong kind or breaks its rule; the message names it.
        MemoryError: the device cannot hold the map.

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
        motion=motion, backend=backend,
    )  # fmt: skip
    for _ in builder.steps():
        pass
    return builder.grid()


class MapBuilder:
    """Builds a map in steps, after each of which the map so far can be read; see :func:`build_map`."""

    def __init__(
        self,
        scans: ArrayLike,
        poses: ArrayLike,
        scanner: Scanner,
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
        each: int = SCANS,
    ) -> None:
        if not isinstance(scanner, Scanner):
            raise TypeError(f"scanner: must be a Scanner, got {checks.show(scanner)}")
        placed = checks.array("poses", poses, ("S", 3))
        readings = checks.array("scans", scans, (len(placed), scanner.count), finite=False)
        scanner._first_scans.look_at("scans", readings)
        cell = checks.real("resolution", resolution, above=0)
        limit = scanner.range_max if range_limit is None else checks.real("range_limit", range_limit, above=0)
        checks.boolean("clear_max", clear_max)
        self._occupancy = _occupancy(p_hit, p_miss, p_prior)
        self._threshold = checks.integer("occupied_threshold", occupied_threshold, low=1, high=100)
        moved = check_motion("motion", motion, len(placed))
        device = get_backend(backend)
        self._parts = [
            RayEnds(readings[part], placed[part], scanner, min(limit, scanner.range_max), clear_max=clear_max,
                    motion=None if moved is None else moved[part])
            for part in batches(len(placed), each)
        ]  # fmt: skip
        self._counts = RayCounts(device, cell, *_frame(self._parts, cell, origin, shape))

    def steps(self) -> Iterator[float]:
        """Count rays, some scans at a time, and yield the share of scans that are done."""
        for i, part in enumerate(self._parts):
            self._counts.add(part)
            yield (i + 1) / len(self._parts)

    @property
    def rays(self) -> int:
        """Rays that have been counted."""
        return self._counts.rays

    def grid(self) -> OccupancyGrid:
        """Return the map so far."""
        return self._counts.grid(*self._occupancy, self._threshold)


def _occupancy(p_hit: float, p_miss: float, p_prior: float) -> tuple[float, float, float]:
    """Check the probabilities of the inverse sensor model."""
    hit, miss = checks.real("p_hit", p_hit, above=0.5, below=1), checks.real("p_miss", p_miss, above=0, below=0.5)
    return hit, miss, checks.real("p_prior", p_prior, above=0, below=1)


def _frame(
    parts: list[RayEnds], resolution: float, origin: ArrayLike | None, shape: tuple[int, int] | None
) -> tuple[tuple[float, float, float], tuple[int, int]]:
    """Return the map's origin and shape."""
    if (origin is None) != (shape is None):
        missing, present = ("origin", "shape") if origin is None else ("shape", "origin")
        raise ValueError(f"{missing}: must be given with {present}, got None")
    if shape is None:
        return extent(parts, resolution)
    x, y, yaw = checks.array("origin", origin, (3,)).tolist()
    rows, cols = checks.array("shape", shape, (2,), dtype=np.int64).tolist()
    for size in (rows, cols):
        checks.integer("shape", size, low=1, high=LONGEST_SIDE)
    return (x, y, yaw), (rows, cols)
