"""Ray casting on its own: expected ranges of poses and bearings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpusense import _checks
from gpusense.backends import Backend, BackendInfo, get_backend
from gpusense.frames import Mount, place_poses, ray_vectors
from gpusense.grid import OccupancyGrid
from gpusense.models.reachable import ReachableMap
from gpusense.models.scan_model import CHUNK, CHUNK_BYTES, check_poses, check_scene, in_chunks, real_dtype
from gpusense.prepare import quadrant_squares
from gpusense.workspace import Workspace

_NO_MOUNT: Mount = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class CasterMethod:
    """A way to find expected ranges.

    Attributes:
        name: What to pass as ``method=`` or ``caster=``.
        error: ``"exact"``, or the bound of its error.
        memory: Bytes on the device.
        precomputation: What is made of the map beforehand.
        backends: Where it runs.
    """

    name: str
    error: str
    memory: str
    precomputation: str
    backends: tuple[str, ...]


_METHODS = (
    CasterMethod(
        "exact",
        "exact: float64 to 1e-12 relative; float32 the same bits on every device",
        "4 bytes per cell of the reachable map",
        "quadrant empty squares, one pass over the map per quadrant",
        ("numpy", "opencl", "warp"),
    ),
)
CASTERS = tuple(method.name for method in _METHODS)


class RayCaster:
    """Distance to the first occupied cell along rays.

    Args:
        grid: The map.
        range_max: Longest range [m], > 0; what a ray without a nearer obstacle returns.
        method: ``"exact"``; see ``RayCaster.methods()``.
        backend: Where it runs; see ``gpusense.devices()``.
        precision: ``"float32"`` or ``"float64"``.
        unknown: Whether unknown cells are ``"free"`` or ``"occupied"``.
        outside: Whether what lies outside the grid is ``"free"`` or ``"occupied"``.

    Raises:
        TypeError: an argument is of the wrong kind.
        ValueError: an argument breaks its rule, or the device is absent.
    """

    def __init__(
        self,
        grid: OccupancyGrid,
        range_max: float,
        *,
        method: str = "exact",
        backend: str | Backend = "auto",
        precision: str = "float32",
        unknown: str = "free",
        outside: str = "free",
    ) -> None:
        self.range_max = _checks.real("range_max", range_max, above=0)
        self.grid = check_scene(grid, self.range_max)
        self.method = _checks.choice("method", method, CASTERS)
        self.unknown = _checks.choice("unknown", unknown, ("free", "occupied"))
        self.outside = _checks.choice("outside", outside, ("free", "occupied"))
        self._backend = get_backend(backend)
        self._real = real_dtype(precision, self._backend)
        self._workspace = Workspace(self._backend)
        reach = self.range_max / grid.resolution
        self._map = ReachableMap(self._backend, grid, unknown, _NO_MOUNT, reach, quadrant_squares, crop=True)

    @staticmethod
    def methods() -> tuple[CasterMethod, ...]:
        """The methods there are, with their error, memory, precomputation and backends."""
        return _METHODS

    @property
    def device(self) -> BackendInfo:
        """The device the caster is compiled for."""
        return self._backend.info

    @property
    def precision(self) -> str:
        """``"float32"`` or ``"float64"``."""
        return self._real.name

    def cast(self, poses: object, bearings: object) -> np.ndarray:
        """Expected ranges.

        Args:
            poses: (N, 3) ray origins and headings in the world [m, m, rad].
            bearings: (K,) directions relative to the heading [rad].

        Returns:
            (N, K) metres in the caster's precision: 0 inside an occupied cell, exactly ``range_max`` where nothing is
            nearer.

        Raises:
            TypeError, ValueError: arguments that are not finite numbers of these shapes.
        """
        vectors = ray_vectors(_checks.array("bearings", bearings, ("K",)), _NO_MOUNT)
        return cast_all(
            self._backend, self._workspace, self._map, self.grid, _NO_MOUNT, vectors, check_poses(poses), self._real,
            self.range_max, self.outside == "occupied",
        )  # fmt: skip


def cast_all(
    backend: Backend,
    workspace: Workspace,
    reachable: ReachableMap,
    grid: OccupancyGrid,
    mount: Mount,
    vectors: np.ndarray,
    poses: np.ndarray,
    real: np.dtype,
    range_max: float,
    outside_occupied: bool,
) -> np.ndarray:
    """Expected ranges (N, K) of (N, 3) poses and (K, 2) ray vectors, in pieces that fit the device."""
    rays = len(vectors)
    ranges = np.empty((len(poses), rays), real)
    if ranges.size == 0:
        return ranges
    ray = workspace.upload("cast_ray", vectors.astype(real))
    flags = {"FLOAT64"} if real == np.float64 else set()
    flags |= {"OUTSIDE_OCCUPIED"} if outside_occupied else set()

    def run(begin: int, end: int) -> None:
        squares, region = reachable.ensure(poses[begin:end])
        placed = place_poses(poses[begin:end], grid, mount, real)
        placed.cell[:] -= (region.col, region.row)
        inside = ((placed.cell >= 0) & (placed.cell < (region.cols, region.rows))).all()
        count = end - begin
        result = workspace.empty("ranges", count * rays, real)
        backend.compile("cast_ranges", frozenset(flags if inside else flags | {"ORIGINS_OUTSIDE"}))(
            (rays, count), squares, workspace.upload("cell", placed.cell), workspace.upload("pose", placed.pose), ray,
            result, region.rows, region.cols, count, rays, range_max / grid.resolution, grid.resolution, range_max,
        )  # fmt: skip
        backend.download(result, ranges[begin:end])

    in_chunks(len(poses), max(min(CHUNK, CHUNK_BYTES // (rays * real.itemsize)), 1), workspace, run)
    return ranges
