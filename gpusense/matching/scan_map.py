"""A small map of one scan, on which methods for maps match other scans."""

from __future__ import annotations

import numpy as np

from gpusense.backends import Backend
from gpusense.matching.options import MatchOptions
from gpusense.matching.result import ScanMatch
from gpusense.matching.to_map import MapMatcher
from gpusense.world.frames import ray_vectors
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Reading, Scanner, classes

# Side of a cell in capture radii, and most cells along a side; larger scans have larger cells.
_CELL, _MOST_CELLS = 0.05, 1500


def scan_map(ranges: np.ndarray, scanner: Scanner, margin: float, cell: float) -> OccupancyGrid:
    """Return the map of a scan in the robot's frame: cells of hits are occupied, all others unknown.

    Args:
        ranges: (K,) readings [m].
        scanner: The scanner.
        margin: Width of the space around the hits [m].
        cell: Least side of a cell [m].
    """
    hits = classes(ranges, scanner.range_min, scanner.range_max) == Reading.HIT
    place = ranges[hits, None] * ray_vectors(scanner.bearings, scanner.mount)[hits] + np.array(scanner.mount[:2])
    if not len(place):
        place = np.zeros((1, 2))
    low = place.min(axis=0) - margin
    size = float((place.max(axis=0) + margin - low).max())
    cell = max(cell, size / _MOST_CELLS)
    cols, rows = (np.ceil((place.max(axis=0) + margin - low) / cell)).astype(int)
    cells = np.full((rows, cols), -1, np.int8)
    if hits.any():
        col, row = np.floor((place - low) / cell).astype(int).T
        cells[row, col] = 100
    return OccupancyGrid(cells, resolution=cell, origin=(float(low[0]), float(low[1]), 0.0))


def match_by_maps(
    references: np.ndarray, ranges: np.ndarray, scanner: Scanner, guess: np.ndarray, method: str, backend: Backend,
    precision: str, options: MatchOptions,
) -> ScanMatch:  # fmt: skip
    """Match (S, K) readings to maps of (S, K) or (1, K) references from (S, 3) guesses, one after the other."""
    matches = []
    matcher = None
    for i, scan in enumerate(ranges):
        if matcher is None or len(references) > 1:
            grid = scan_map(references[i], scanner, options.capture, _CELL * options.capture)
            matcher = MapMatcher(grid, scanner, backend, precision, options)
        matches.append(matcher.match(scan[None], guess[i : i + 1], method))
    return ScanMatch.joined(matches)
