"""Calls of few particles in NumPy arrays on a GPU: inputs go to the device as one array, results come back as one.

A copy of few numbers takes as long as a launch, and the device classes a scan faster than the host. Therefore the
recording of :class:`.bound.DeviceCall` follows the copy, and the device classes the readings. On CUDA, copies and
launches form one graph. Bound calls of such arrays work like this, and so do ordinary calls that repeat a size.
"""

from __future__ import annotations

import math
import threading
from typing import Any

import numpy as np

from gpusense.backends import Backend, arrays
from gpusense.backends.programs import ProgramCache
from gpusense.backends.workspace import Workspace
from gpusense.models.poses import corners_of
from gpusense.models.scan.bound import DeviceCall
from gpusense.models.scan.pipeline import ScanPipeline
from gpusense.models.scan.tiles import LEAST_ORDERED
from gpusense.world.scanner import classify_ranges
from gpusense.world.windows import Corners

# Largest size that is copied with the launches [bytes]; longer arrays take the ordinary call.
LARGEST = 256 << 10
_DOUBLE, _INT = np.dtype(np.float64), np.dtype(np.int32)
_FLOATS = (np.dtype(np.float32), _DOUBLE)
# Alignment of arrays that are copied as one [bytes], enough for every device.
_ALIGNED = 1024
# Number of sizes of short calls that are kept; ordinary calls of a size before the first short one; largest map that
# may have two tables [cells].
_MOST_SIZES, _BEFORE, _MOST_CELLS = 8, 2, 1 << 22


def fits(count: int, readings: int) -> bool:
    """Return whether poses and readings are few enough to be copied with the launches."""
    return _DOUBLE.itemsize * (3 * count + readings) <= LARGEST


def is_short(count: int, readings: int) -> bool:
    """Return whether a call of poses and readings is worth a recording."""
    return 0 < count * readings < LEAST_ORDERED[0]


def host_task(pipeline: ScanPipeline) -> str:
    """Return the preparation that only the host can do, as a clause; empty where the device can do all of it."""
    if pipeline.setting.weights.is_peer:
        return "the host classes the readings for another program's weights"
    if not pipeline.backend.info.float64:
        return "the host places the poses, as the device has no float64"
    return ""


class _Pack:
    """Packed arrays, on the host and on the device, that are copied as one.

    Attributes:
        host: The packed array on the host.
        on_device: The packed array on the device.
        views: The arrays on the host.
        parts: The arrays on the device.
    """

    def __init__(self, backend: Backend, dtype: np.dtype, *arrays: tuple[int, np.dtype]) -> None:
        begins, size = [], 0
        for count, dtype_of in arrays:
            begins.append(size)
            size += -(-count * dtype_of.itemsize // _ALIGNED) * _ALIGNED
        self.host = np.zeros(size // dtype.itemsize, dtype)
        self.on_device = backend.upload(self.host, backend.blank(self.host.size, dtype))
        numbers = self.host.view(np.uint8)
        self.views, self.parts = [], []
        for begin, (count, dtype_of) in zip(begins, arrays, strict=True):
            self.views.append(numbers[begin : begin + count * dtype_of.itemsize].view(dtype_of))
            self.parts.append(backend.part(self.on_device, begin // dtype_of.itemsize, count, dtype_of))


class PackedCall:
    """The recorded program of a number of poses.

    Poses and readings are float64 on the device, exact for float32. Limits of readings are rounded to the precision of
    the readings, as on the host.

    Args:
        pipeline: The stages of the model.
        lock: Held while the program is recorded.
        count: Number of poses.
        limits: The type of the readings.
        corners: Corners of the box of the first poses; None for the table of the whole map.

    Attributes:
        arrays: The poses and the readings of the last call.
    """

    def __init__(
        self, pipeline: ScanPipeline, lock: threading.Lock, count: int, limits: np.dtype, corners: Corners | None = None
    ) -> None:
        self._backend = backend = pipeline.backend
        readings, real = pipeline.scanner.count, pipeline.real
        self._inputs = _Pack(backend, _DOUBLE, (3 * count, _DOUBLE), (readings, _DOUBLE))
        self._outputs = _Pack(backend, real, (count, real), (2, _INT))
        self.arrays = self._inputs.views[0].reshape(count, 3), self._inputs.views[1]
        poses, ranges = self._inputs.parts
        log_p, status = self._outputs.parts
        self._device = DeviceCall(
            pipeline, lock, backend.lend(poses, (count, 3), _DOUBLE), backend.lend(ranges, (readings,), _DOUBLE),
            backend.lend(log_p, (count,), real), status, limits, corners,
        )  # fmt: skip
        self._space = Workspace(backend)

    def score(self, poses: np.ndarray, ranges: np.ndarray, out: np.ndarray, corners: Corners | None = None) -> bool:
        """Score poses, and write their log-likelihoods.

        Args:
            poses: (N, 3) poses.
            ranges: (K,) readings.
            out: (N,) array for the log-likelihoods.
            corners: Corners of the box of the poses; None for the table of the whole map.

        Returns:
            False where a pose is not finite; nothing is written then.

        Raises:
            MemoryError: The device cannot hold the map's table.
        """
        backend, inputs, outputs = self._backend, self._inputs, self._outputs
        (own_poses, own_ranges), (log_p, status) = self.arrays, outputs.views
        own_poses[...] = poses
        own_ranges[...] = ranges
        with self._space:
            backend.upload(inputs.host, inputs.on_device, wait=False)
            self._device.begin(corners)
            backend.download(outputs.on_device, outputs.host, wait=not backend.in_batch)
            if backend.in_batch:
                backend.synchronize()
        if not status[0]:
            out[...] = log_p
            return True
        status[...] = 0
        backend.upload(status, outputs.parts[1])
        return False

    def explain(self) -> str:
        """Return in one line how the launches are started."""
        return self._device.explain()


class ShortCalls:
    """Ordinary calls of a model that repeat a size of few particles.

    Results have the bits of ordinary calls; a call for which this is not certain is left to the ordinary path.

    Args:
        pipeline: The stages of the model.

    Attributes:
        last: The last call; None if it was not a short one.
    """

    def __init__(self, pipeline: ScanPipeline) -> None:
        self._pipeline = pipeline
        self.last: PackedCall | None = None
        self._calls = ProgramCache[PackedCall](_MOST_SIZES)
        # Number of calls by size so far.
        self._seen = ProgramCache[int](_MOST_SIZES)
        # A private lock, since the scoring thread holds the model's lock.
        self._lock = threading.Lock()

    @staticmethod
    def of(pipeline: ScanPipeline) -> ShortCalls | None:
        """Return the short calls of a model; None if its device or its options exclude them."""
        if not pipeline.backend.replays or host_task(pipeline) or pipeline.grid.cells.size > _MOST_CELLS:
            return None
        certain = pipeline.specialize and pipeline.rules.separate and pipeline.setting.possible
        return ShortCalls(pipeline) if certain else None

    def score(self, poses: Any, ranges: Any, out: Any, *, per_beam: bool) -> np.ndarray | None:
        """Score poses by the readings of a scan; None if the ordinary call must do it.

        Args:
            poses: Poses as ``log_likelihood`` takes them.
            ranges: Its readings.
            out: Its array for the result, or None.
            per_beam: True if the log-likelihoods of the readings are requested.
        """
        self.last = None
        if per_beam or type(poses) is not np.ndarray or type(ranges) is not np.ndarray:
            return None
        pipeline, count = self._pipeline, len(poses) if poses.ndim else 0
        if poses.shape != (count, 3) or ranges.shape != (pipeline.scanner.count,):
            return None
        if poses.dtype not in _FLOATS or ranges.dtype not in _FLOATS or not self._takes(count, out):
            return None
        corners = self._corners(poses) if self._repeats(count, ranges.dtype) else None
        if corners is None or (pipeline.setting.temperature < 1 and not self._has_range(ranges)):
            return None
        result = np.empty(count, pipeline.real) if out is None else out
        key = (count, ranges.dtype)
        try:
            call = self._calls.get(key)
            call = call or self._calls.keep(key, PackedCall(pipeline, self._lock, count, ranges.dtype, corners))
            call.score(poses, ranges, result, corners)
        except MemoryError:
            # The buffers of both kinds of calls may not fit the device at once.
            self._calls.clear()
            return None
        self.last = call
        if pipeline.rules.first_scans.left:
            pipeline.rules.first_scans.look_at("ranges", ranges[None], pipeline.rules.map_size)
        return result

    def _takes(self, count: int, out: Any) -> bool:
        """Return whether the call has the size of a short call, and results can be written."""
        if not is_short(count, self._pipeline.scanner.count) or not fits(count, self._pipeline.scanner.count):
            return False
        if out is None:
            return True
        usable = type(out) is np.ndarray and out.dtype == self._pipeline.real and out.shape == (count,)
        return usable and out.flags.c_contiguous and out.flags.writeable

    def _repeats(self, count: int, limits: np.dtype) -> bool:
        """Count a call of a size, and return whether the size has occurred often."""
        seen = self._seen.get((count, limits)) or 0
        if seen < _BEFORE:
            self._seen.keep((count, limits), seen + 1)
        return seen >= _BEFORE

    def _has_range(self, ranges: np.ndarray) -> bool:
        """Return whether a reading depends on the pose; without one the constant term is rounded differently."""
        return bool(classify_ranges(ranges, *self._pipeline.rules.limits)[0].any())

    def _corners(self, poses: np.ndarray) -> Corners | None:
        """Return corners of the box of poses; None where one is not finite."""
        low, high = arrays.bounds_of(np.asarray(poses, np.float64))
        if not all(map(math.isfinite, (*low, *high))):
            return None
        return corners_of((low, high))
