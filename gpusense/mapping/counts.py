"""Hits and misses of cells, counted on a device ray by ray, and the occupancy grid that follows from them."""

from __future__ import annotations

import math

import numpy as np

from gpusense.backends import Backend
from gpusense.backends.workspace import Workspace
from gpusense.interface.constants import RAY_BITS
from gpusense.interface.launches import launch
from gpusense.world.frames import ray_vectors
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Reading, Scanner, classify
from gpusense.world.sweep import beam_poses
from gpusense.world.windows import LONGEST_SIDE

_INT = np.dtype(np.int32)
# Scans whose rays are counted in one launch.
SCANS = 1024


class RayEnds:
    """Start and end of each ray of scans in the world, as far as they say something about the map.

    Args:
        scans: (S, K) readings [m].
        poses: (S, 3) poses of the robot [m, m, rad].
        scanner: The scanner's geometry.
        range_limit: Readings beyond it clear cells up to it and mark no obstacle [m].
        clear_max: Whether max readings clear cells up to ``range_limit``; otherwise they are left out.
        motion: (S, 3) motions of the robot during the scans, see ``gpusense.world.sweep``; None: it is at rest.

    Attributes:
        start: (R, 2) [m].
        end: (R, 2) [m].
        hit: (R,) whether an obstacle is at the end.
    """

    def __init__(
        self, scans: np.ndarray, poses: np.ndarray, scanner: Scanner, range_limit: float, *, clear_max: bool,
        motion: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        kinds = classify(scans, scanner)
        hit = (kinds == Reading.HIT) & (scans <= range_limit)
        used = (kinds == Reading.HIT) | (kinds == Reading.MAX) if clear_max else kinds == Reading.HIT
        length = np.where(hit, scans, range_limit)[used]
        scan, beam = np.nonzero(used)
        poses = poses[scan] if motion is None else _poses_of_beams(poses, motion, scanner.count)[scan, beam]
        cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        x, y, _ = scanner.mount
        along, across = ray_vectors(scanner.bearings, scanner.mount)[beam].T
        turned = np.stack([cos * along - sin * across, sin * along + cos * across], axis=1)
        self.start = poses[:, :2] + np.stack([cos * x - sin * y, sin * x + cos * y], axis=1)
        self.end = self.start + length[:, None] * turned
        self.hit = hit[used]


def _poses_of_beams(poses: np.ndarray, motion: np.ndarray, beams: int) -> np.ndarray:
    """Return the (S, K, 3) poses in the world of a robot that moves during S scans."""
    place, heading = beam_poses(motion, beams)
    cos, sin = np.cos(poses[:, 2])[:, None], np.sin(poses[:, 2])[:, None]
    x = poses[:, 0, None] + cos * place[..., 0] - sin * place[..., 1]
    y = poses[:, 1, None] + sin * place[..., 0] + cos * place[..., 1]
    return np.stack([x, y, poses[:, 2, None] + heading], axis=-1)


class RayCounts:
    """Hits and misses of the cells of a grid on a device.

    Args:
        backend: The device.
        resolution: Side of a cell [m].
        origin: Pose (x, y, yaw) of the outer corner of the first cell [m, m, rad].
        shape: Rows and columns.

    Attributes:
        rays: Rays that have been counted.
    """

    def __init__(
        self, backend: Backend, resolution: float, origin: tuple[float, float, float], shape: tuple[int, int]
    ) -> None:
        self._backend, self._shape = backend, shape
        self._frame = OccupancyGrid([[0]], resolution, origin)
        self._space = Workspace(backend)
        self._hits = backend.upload(np.zeros(shape, _INT))
        self._misses = backend.upload(np.zeros(shape, _INT))
        self.rays = 0

    def add(self, ends: RayEnds) -> None:
        """Count the cells of rays."""
        if len(ends.hit) == 0:
            return
        places = [
            np.rint(self._frame.world_to_cells(xy) * (1 << RAY_BITS)).clip(-(2.0**30), 2.0**30).astype(np.int32)
            for xy in (ends.start, ends.end)
        ]
        rows, cols = self._shape
        with self._space as space:
            start, end = (space.upload(name, place) for name, place in zip(("start", "end"), places, strict=True))
            one = launch(
                "count_rays", (), (len(ends.hit),), start=start, end=end,
                hit=space.upload("hit", ends.hit.astype(np.int32)), hits=self._hits, misses=self._misses, rows=rows,
                cols=cols, rays=len(ends.hit),
            )  # fmt: skip
            self._backend.run((one,))
            space.wait()
        self.rays += len(ends.hit)

    def counts(self) -> tuple[np.ndarray, np.ndarray]:
        """Return (H, W) int32 hits and misses."""
        download = self._backend.download
        return download(self._hits, np.empty(self._shape, _INT)), download(self._misses, np.empty(self._shape, _INT))

    def grid(self, p_hit: float, p_miss: float, p_prior: float, occupied_threshold: int) -> OccupancyGrid:
        """Return the occupancy grid; cells without a ray are unknown.

        Args:
            p_hit: Occupancy of a cell after one hit and an even prior.
            p_miss: Occupancy of a cell after one miss and an even prior.
            p_prior: Occupancy before any ray.
            occupied_threshold: Least occupancy of an occupied cell [per cent].
        """
        hits, misses = self.counts()
        odds = hits * log_odds(p_hit) + misses * log_odds(p_miss) + log_odds(p_prior)
        # exp(40) needs no larger exponent: the occupancy is 0 or 100 per cent by then.
        cells = np.rint(100 / (1 + np.exp(-np.clip(odds, -40, 40)))).astype(np.int8)
        cells[(hits == 0) & (misses == 0)] = -1
        frame = self._frame
        return OccupancyGrid(cells, frame.resolution, frame.origin, occupied_threshold=occupied_threshold)


def log_odds(p: float) -> float:
    """Return the log-odds of a probability."""
    return math.log(p / (1 - p))


def extent(parts: list[RayEnds], resolution: float) -> tuple[tuple[float, float, float], tuple[int, int]]:
    """Return origin and shape of the smallest map of whole cells that holds all rays, with a cell to spare around it.

    Raises:
        ValueError: no ray, or a map that is too large.
    """
    if not any(len(part.hit) for part in parts):
        raise ValueError("scans: must have a range, got none")
    both = np.concatenate([xy for part in parts for xy in (part.start, part.end)])
    low = np.floor(both.min(axis=0) / resolution) - 1
    size = np.floor(both.max(axis=0) / resolution) + 2 - low
    if not (size <= LONGEST_SIDE).all():
        raise ValueError(
            f"resolution: the map must have at most {LONGEST_SIDE} rows and columns, got {size[1]:.0f} x {size[0]:.0f}"
        )
    x, y = (low * resolution).tolist()
    return (x, y, 0.0), (int(size[1]), int(size[0]))


def batches(count: int, each: int = SCANS) -> list[slice]:
    """Return the scans of each launch."""
    return [slice(first, min(first + each, count)) for first in range(0, count, each)]
