"""Ray casting on its own: expected ranges of poses and bearings."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np

from gpusense import _checks
from gpusense.backends import Backend, BackendInfo, get_backend
from gpusense.backends.base import Buffer
from gpusense.frames import Mount, ray_vectors
from gpusense.grid import OccupancyGrid
from gpusense.models.reachable import ReachableMap
from gpusense.models.scan_model import check_poses, check_scene, chunk_of, in_chunks, place_in, real_dtype
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
        device = get_backend(backend)
        real = real_dtype(precision, device)
        self._caster = ExactCaster(
            device, real, grid, _NO_MOUNT, self.range_max, unknown=unknown, outside=outside, crop=True
        )

    @staticmethod
    def methods() -> tuple[CasterMethod, ...]:
        """The methods there are, with their error, memory, precomputation and backends."""
        return _METHODS

    @property
    def device(self) -> BackendInfo:
        """The device the caster is compiled for."""
        return self._caster.backend.info

    @property
    def precision(self) -> str:
        """``"float32"`` or ``"float64"``."""
        return self._caster.real.name

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
        return self._caster.cast(check_poses(poses), vectors)


class ExactCaster:
    """The exact caster of one map, sensor mount and range on one device; models share its table of the map.

    Args:
        backend: The device.
        real: Precision.
        grid: The map.
        mount: The sensor's pose on the robot; its yaw belongs to the ray vectors.
        range_max: Longest range [m].
        unknown: Whether unknown cells are ``"free"`` or ``"occupied"``.
        outside: Whether what lies outside the grid is ``"free"`` or ``"occupied"``.
        crop: False prepares the whole map at once.
    """

    def __init__(
        self,
        backend: Backend,
        real: np.dtype,
        grid: OccupancyGrid,
        mount: Mount,
        range_max: float,
        *,
        unknown: str,
        outside: str,
        crop: bool,
    ) -> None:
        self.backend, self.real, self.grid, self.mount, self.range_max = backend, real, grid, mount, range_max
        self.limit = range_max / grid.resolution
        self.map = ReachableMap(backend, grid, unknown, mount, self.limit, quadrant_squares, crop)
        self._flags = frozenset({"OUTSIDE_OCCUPIED"} if outside == "occupied" else ())
        self._flags |= {"FLOAT64"} if real == np.float64 else set()
        self._workspace = Workspace(backend)
        # Threads may share a caster: its buffers serve one call at a time.
        self._lock = threading.Lock()

    def cast(self, poses: np.ndarray, vectors: np.ndarray) -> np.ndarray:
        """Expected ranges (N, K) of (N, 3) float64 poses and (K, 2) ray vectors, in pieces that fit the device."""
        rays = len(vectors)
        ranges = np.empty((len(poses), rays), self.real)
        if ranges.size == 0:
            return ranges
        with self._lock:
            ray = self._workspace.upload("ray", vectors.astype(self.real))
            chunk = chunk_of(self.backend, rays, self.real.itemsize)
            in_chunks(
                len(poses), chunk, self._workspace,
                lambda begin, end: self._cast_chunk(poses[begin:end], ray, ranges[begin:end]),
            )  # fmt: skip
        return ranges

    def _cast_chunk(self, poses: np.ndarray, ray: Buffer, ranges: np.ndarray) -> None:
        space = self._workspace
        squares, region = self.map.ensure(poses)
        placed, beyond = place_in(region, poses, self.grid, self.mount, self.real)
        count, rays = ranges.shape
        result = space.empty("ranges", ranges.size, self.real)
        self.backend.compile("cast_ranges", self._flags | {"ORIGINS_OUTSIDE"} if beyond else self._flags)(
            (rays, count), squares, space.upload("cell", placed.cell), space.upload("pose", placed.pose), ray, result,
            region.rows, region.cols, count, rays, self.limit, self.grid.resolution, self.range_max,
        )  # fmt: skip
        self.backend.download(result, ranges)
