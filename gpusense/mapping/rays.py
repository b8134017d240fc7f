"""Convert scans at known poses to rays, clip rays to windows of a map, and count hits and misses of its cells."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from gpusense.backends import Backend
from gpusense.backends.workspace import Workspace
from gpusense.interface.constants import RAY_BITS
from gpusense.interface.launches import launch
from gpusense.world.deskew import beam_poses
from gpusense.world.frames import ray_vectors
from gpusense.world.grid import FARTHEST_ORIGIN, GridFrame
from gpusense.world.pose_algebra import rotated
from gpusense.world.scanner import Reading, Scanner, classify
from gpusense.world.windows import LONGEST_SIDE, Window

# Number of scans per launch.
SCANS = 1024
LONGEST_RAY = 1 << 19
"""Most cells of a ray along an axis of the map: products of lengths in 1/4096 cell fit in 64 bits."""


class RayEnds(NamedTuple):
    """Start and end in the world of each ray that carries information about the map."""

    start: np.ndarray  # (R, 2) [m]
    end: np.ndarray  # (R, 2) [m]
    hit: np.ndarray  # (R,) whether an obstacle is at the end
    scan: np.ndarray  # (R,) index of the scan, ascending

    @classmethod
    def of_scans(
        cls, scans: np.ndarray, poses: np.ndarray, scanner: Scanner, range_limit: float, *, clear_max: bool,
        motion: np.ndarray | None = None,
    ) -> RayEnds:  # fmt: skip
        """Return the rays of (S, K) readings at (S, 3) poses; ``motion`` (S, 3) is the robot's during scans, or None.

        Longer readings than ``range_limit`` clear cells up to it and mark no obstacle, and so do max readings if
        ``clear_max``.
        """
        kinds = classify(scans, scanner)
        hit = (kinds == Reading.HIT) & (scans <= range_limit)
        used = (kinds == Reading.HIT) | (kinds == Reading.MAX) if clear_max else kinds == Reading.HIT
        length = np.where(hit, scans, range_limit)[used]
        scan, beam = np.nonzero(used)
        poses = poses[scan] if motion is None else _poses_of_beams(poses, motion, scanner.count)[scan, beam]
        vectors = ray_vectors(scanner.bearings, scanner.mount)[beam]
        with np.errstate(over="ignore", invalid="ignore"):
            start = poses[:, :2] + rotated(np.array([scanner.mount[:2]]), poses[:, 2])
            end = start + length[:, None] * rotated(vectors, poses[:, 2])
        return cls(start, end, hit[used], scan)

    @classmethod
    def joined(cls, parts: list[RayEnds]) -> RayEnds:
        """Return the rays of several parts in the order of their scans."""
        whole = [np.concatenate(values) for values in zip(*parts, strict=True)]
        order = np.argsort(whole[3], kind="stable")
        return cls(*(values[order] for values in whole))

    def boxes(self, count: int, frame: GridFrame) -> np.ndarray:
        """Return the (S, 4) bounds of each scan's rays, columns and rows [cells], reversed infinities without rays."""
        both = np.stack([frame.to_cells(xy) for xy in (self.start, self.end)])
        boxes = np.tile([np.inf, np.inf, -np.inf, -np.inf], (count, 1))
        first = np.flatnonzero(np.diff(self.scan, prepend=-1))
        if len(first):
            of = self.scan[first]
            boxes[of, :2] = np.minimum.reduceat(both.min(axis=0), first, axis=0)
            boxes[of, 2:] = np.maximum.reduceat(both.max(axis=0), first, axis=0)
        return boxes


def _poses_of_beams(poses: np.ndarray, motion: np.ndarray, beams: int) -> np.ndarray:
    """Return the (S, K, 3) poses of a moving robot at each beam of S scans."""
    place, heading = beam_poses(motion, beams)
    cos, sin = np.cos(poses[:, 2])[:, None], np.sin(poses[:, 2])[:, None]
    x = poses[:, 0, None] + cos * place[..., 0] - sin * place[..., 1]
    y = poses[:, 1, None] + sin * place[..., 0] + cos * place[..., 1]
    return np.stack([x, y, poses[:, 2, None] + heading], axis=-1)


def _in_cells(
    ends: RayEnds, frame: GridFrame, window: Window, shape: tuple[int, int]
) -> tuple[dict[str, np.ndarray], int]:
    """Return the rays that meet a window of a map by the kernel's arguments, and how many end in its rows.

    Starts and ends have an int32 column and row (R, 2), relative to the window, and a position inside the cell [1/4096
    cell]. Ends are clamped to the map for counting them.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        start, end = frame.to_cells(ends.start), frame.to_cells(ends.end)
        low, high = np.minimum(start, end), np.maximum(start, end)
        first, last = (window.col, window.row), (window.col + window.cols, window.row + window.rows)
        # Enlarge the window by a cell for rounded coordinates.
        meets = ((high >= np.subtract(first, 1)) & (low <= np.add(last, 1))).all(axis=1)
        row = np.clip(end[:, 1], 0, shape[0] - 1)
        ending = int(np.count_nonzero(meets & (row >= first[1]) & (row < last[1])))
        rays = {"hit": ends.hit[meets].astype(np.int32)}
        for name, xy in (("start", start), ("end", end)):
            place = np.rint(xy[meets] * (1 << RAY_BITS)).astype(np.int64) - (np.array(first) << RAY_BITS)
            rays[f"{name}_cell"] = (place >> RAY_BITS).astype(np.int32)
            rays[f"{name}_inside"] = (place & ((1 << RAY_BITS) - 1)).astype(np.int32)
    return rays, ending


def check_lengths(ends: RayEnds, resolution: float, first: int) -> None:
    """Refuse rays that span more cells than a walk can count."""
    if len(ends.hit) == 0:
        return
    with np.errstate(over="ignore", invalid="ignore"):
        cells = np.abs(ends.end - ends.start).max(axis=1) / resolution
    longest = int(np.argmax(np.where(np.isnan(cells), np.inf, cells)))
    if not cells[longest] <= LONGEST_RAY:
        rule = f"a ray must span at most {LONGEST_RAY} cells along an axis"
        raise ValueError(f"scans: {rule}, got {cells[longest]:.0f} in scan {first + int(ends.scan[longest])}")


def extent(boxes: np.ndarray, resolution: float) -> tuple[tuple[float, float, float], tuple[int, int]]:
    """Return origin and shape of the smallest map of whole cells around all rays, with a margin of one cell."""
    low, high = boxes[:, :2].min(axis=0, initial=np.inf), boxes[:, 2:].max(axis=0, initial=-np.inf)
    if not (low <= high).all():
        raise ValueError("scans: must have a range, got none")
    if not max(-low.min(), high.max()) < FARTHEST_ORIGIN:
        rule = f"all rays must lie within {FARTHEST_ORIGIN:g} m of 0"
        raise ValueError(f"poses: {rule}, got {max(-low.min(), high.max()):g} m")
    low = np.floor(low / resolution) - 1
    size = np.floor(high / resolution) + 2 - low
    if not (size <= LONGEST_SIDE).all():
        raise ValueError(
            f"resolution: the map must have at most {LONGEST_SIDE} rows and columns, got {size[1]:.0f} x {size[0]:.0f}"
        )
    x, y = (low * resolution).tolist()
    return (x, y, 0.0), (int(size[1]), int(size[0]))


def batches(scans: np.ndarray, each: int) -> list[np.ndarray]:
    """Split the indices of scans into launches."""
    return [scans[first : first + each] for first in range(0, len(scans), each)]


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
        rays, ending = _in_cells(ends, self._frame, self._band, self._shape)
        self.rays += ending
        count = len(rays["hit"])
        if count == 0:
            return
        with self._space as space:
            placed = {name: space.upload(name, values) for name, values in rays.items()}
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
        """Write the occupancies of cells with rays into the (H, W) int8 map; ``model`` is p_hit, p_miss and p_prior."""
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
