"""Calls of few particles on a GPU: inputs of the host go to the device as one array, results come back as one.

Arrays on the device are copied to the places of the recorded program, or used in place by bound calls.

A copy of few numbers takes as long as a launch, and the device classes a scan faster than the host. Therefore the
recording of :class:`.bound.DeviceCall` follows the copy, and the device classes the readings. On CUDA, copies and
launches form one graph. Bound calls of such arrays work like this, and so do ordinary calls that repeat a size.
"""

from __future__ import annotations

import functools
import math
import threading
from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np

from gpusense.backends import Backend, arrays
from gpusense.backends.base import Buffer
from gpusense.backends.programs import ProgramCache
from gpusense.backends.results import Result
from gpusense.backends.workspace import Workspace
from gpusense.models.poses import corners_of
from gpusense.models.scan.bound import DeviceCall
from gpusense.models.scan.pipeline import ScanPipeline
from gpusense.models.scan.tiles import LEAST_ORDERED
from gpusense.world.scanner import classify_ranges
from gpusense.world.windows import Corners

# Largest size that is copied with the launches [bytes]; longer arrays take the ordinary call.
LARGEST = 256 << 10
# Largest map of which a short call makes the whole table [cells].
MOST_CELLS = 1 << 22
_DOUBLE, _INT = np.dtype(np.float64), np.dtype(np.int32)
_FLOATS = (np.dtype(np.float32), _DOUBLE)
# Types of poses and readings on the device (None on the host), type of the limits; buffers; owners of their memory.
_Adoption: TypeAlias = tuple[
    tuple[np.dtype | None, np.dtype | None, np.dtype], tuple[Buffer | None, Buffer | None], tuple[Any, ...]
]
# Alignment of arrays that are copied as one [bytes], enough for every device.
_ALIGNED = 1024
# Number of sizes of short calls that are kept; ordinary calls of a size before the first short one.
_MOST_SIZES, _BEFORE = 8, 2


def fits(count: int, readings: int) -> bool:
    """Return whether poses and readings are few enough to be copied with the launches."""
    return _DOUBLE.itemsize * (3 * count + readings) <= LARGEST


def is_short(count: int, readings: int) -> bool:
    """Return whether a call of poses and readings is worth a recording."""
    return 0 < count * readings < LEAST_ORDERED[0]


def host_task(pipeline: ScanPipeline) -> str:
    """Return the preparation that only the host can do, as a clause; empty where the device can do all of it."""
    if pipeline.context.weights.is_peer:
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
        self.on_device = backend.upload(self.host, backend.empty_external(self.host.size, dtype))
        numbers = self.host.view(np.uint8)
        self.views, self.parts = [], []
        for begin, (count, dtype_of) in zip(begins, arrays, strict=True):
            self.views.append(numbers[begin : begin + count * dtype_of.itemsize].view(dtype_of))
            part = backend.part(self.on_device, begin // dtype_of.itemsize, count, dtype_of) if count else None
            self.parts.append(part)


class PackedCall:
    """The recorded program of a number of poses, of which host arrays are copied with the launches.

    Poses and readings of the host are float64 on the device, exact for float32. Limits of readings are rounded to the
    precision of the readings, as on the host.

    Args:
        pipeline: The stages of the model.
        lock: Held while the program is recorded.
        count: Number of poses.
        limits: The type of the readings; None for the type of those on the device.
        corners: Corners of the box of the first poses; None for the table of the whole map.
        poses: (N, 3) poses on the device, used in place; None for poses of the host.
        ranges: (K,) readings on the device, used in place; None for readings of the host.
        out: (N,) array on the device for the log-likelihoods; None for a host array.

    Attributes:
        arrays: The poses and the readings of the last call.
    """

    def __init__(
        self, pipeline: ScanPipeline, lock: threading.Lock, count: int, limits: np.dtype | None,
        corners: Corners | None = None, *, poses: Any = None, ranges: Any = None, out: Any = None,
    ) -> None:  # fmt: skip
        self._backend = backend = pipeline.backend
        readings, real = pipeline.scanner.count, pipeline.real
        self._inputs = _Pack(
            backend, _DOUBLE, (3 * count if poses is None else 0, _DOUBLE), (readings if ranges is None else 0, _DOUBLE)
        )
        self._outputs = _Pack(backend, real, (count if out is None else 0, real), (2, _INT))
        self._copied = self._inputs.views[0].reshape(-1, 3), self._inputs.views[1]
        self.arrays = tuple(
            here if there is None else there for here, there in zip(self._copied, (poses, ranges), strict=True)
        )
        parts, (log_p, status) = self._inputs.parts, self._outputs.parts
        poses = backend.wrap_external(parts[0], (count, 3), _DOUBLE) if poses is None else poses
        ranges = backend.wrap_external(parts[1], (readings,), _DOUBLE) if ranges is None else ranges
        out = backend.wrap_external(log_p, (count,), real) if out is None else out
        self._device = DeviceCall(pipeline, lock, poses, ranges, out, status, limits, corners)
        self._space = Workspace(backend)

    def score(
        self, poses: np.ndarray | None, ranges: np.ndarray | None, out: np.ndarray | None,
        corners: Corners | None = None, then: Callable[[], None] | None = None,
    ) -> bool:  # fmt: skip
        """Score poses, and write their log-likelihoods.

        Args:
            poses: (N, 3) poses; None for those on the device.
            ranges: (K,) readings; None for those on the device.
            out: (N,) array for the log-likelihoods; None for the one on the device.
            corners: Corners of the box of the poses; None for the table of the whole map.
            then: Function that starts copies of the result on the device.

        Returns:
            False where a pose is not finite; nothing is written on the host then.
        """
        backend, inputs, outputs = self._backend, self._inputs, self._outputs
        log_p, status = outputs.views
        for here, numbers in zip(self._copied, (poses, ranges), strict=True):
            if numbers is not None:
                here[...] = numbers
        with self._space:
            if inputs.host.size:
                backend.upload(inputs.host, inputs.on_device, wait=False)
            self._device.begin(corners)
            backend.download(outputs.on_device, outputs.host, wait=not backend.in_batch)
            if then is not None:
                then()
            if backend.in_batch:
                backend.synchronize()
        if not status[0]:
            if out is not None:
                out[...] = log_p
            return True
        status[...] = 0
        backend.upload(status, outputs.parts[1])
        return False

    def explain(self) -> str:
        """Return in one line how the launches are started."""
        return self._device.explain()


class _There:
    """Arrays on the device that ordinary calls copy to the places of a recorded program, as each call has other arrays.

    Args:
        backend: The device.
        count: Number of poses.
        readings: Number of readings.
        kinds: Types of poses and of readings on the device; None for host arrays.
        real: Type of the result.
    """

    def __init__(
        self,
        backend: Backend,
        count: int,
        readings: int,
        kinds: tuple[np.dtype | None, np.dtype | None],
        real: np.dtype,
    ) -> None:
        self._backend = backend
        self.given: dict[str, Any] = {}
        self._places: list[tuple[Buffer, int] | None] = []
        for name, kind, shape in zip(("poses", "ranges"), kinds, ((count, 3), (readings,)), strict=True):
            place = None
            if kind is not None:
                size = math.prod(shape)
                place = backend.empty_external(size, kind), size * kind.itemsize
                self.given[name] = backend.wrap_external(place[0], shape, kind)
            self._places.append(place)
        self._result = None
        if kinds[0] is not None:
            self._result = backend.empty_external(count, real), count * real.itemsize
            self.given["out"] = backend.wrap_external(self._result[0], (count,), real)

    def take(self, *buffers: Buffer | None) -> None:
        """Start copying poses and readings to their places."""
        for place, buffer in zip(self._places, buffers, strict=True):
            if place is not None:
                self._backend.copy(buffer, *place)

    def deliver(self, target: Buffer) -> None:
        """Start copying the result."""
        if self._result is not None:
            self._backend.copy(self._result[0], target, self._result[1])


class PackedCallCache:
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
        self._calls = ProgramCache[tuple[PackedCall, _There | None]](_MOST_SIZES)
        # Number of calls by size so far.
        self._seen = ProgramCache[int](_MOST_SIZES)
        # A private lock, since the scoring thread holds the model's lock.
        self._lock = threading.Lock()

    @staticmethod
    def of(pipeline: ScanPipeline) -> PackedCallCache | None:
        """Return the short calls of a model; None if its device or its options exclude them."""
        if not pipeline.backend.replays or host_task(pipeline) or pipeline.grid.cells.size > MOST_CELLS:
            return None
        certain = pipeline.specialize and pipeline.rules.separate and pipeline.context.possible
        return PackedCallCache(pipeline) if certain else None

    def score(self, poses: Any, ranges: Any, out: Any, *, per_beam: bool) -> np.ndarray | None:
        """Score poses by the readings of a scan; None if the ordinary call must do it.

        Args:
            poses: Poses as ``log_likelihood`` takes them.
            ranges: Its readings.
            out: Its array for the result, or None.
            per_beam: True if the log-likelihoods of the readings are requested.
        """
        self.last = None
        if type(poses) is np.ndarray and type(ranges) is np.ndarray:
            return None if per_beam else self._score_host(poses, ranges, out)
        pipeline, size = self._pipeline, self._pipeline.scanner.count
        if per_beam or getattr(ranges, "shape", None) != (size,):
            return None
        count = poses.shape[0] if getattr(poses, "shape", ())[1:] == (3,) else 0
        kinds = self._kinds(poses, ranges)
        if kinds is None or not is_short(count, size) or not fits(count, size) or not self._takes(count, out, kinds):
            return None
        there = self._adopted(poses, ranges, kinds)
        if there is None or not self._repeats((count, *there[0])):
            return None
        corners = None if kinds[0] else self._corners(poses)
        if not kinds[0] and corners is None:
            return None
        if pipeline.context.temperature < 1 and (kinds[1] or not self._has_range(ranges)):
            return None
        try:
            return self._scored(poses, ranges, out, count, there, corners)
        except MemoryError:
            # The buffers of both kinds of calls may not fit the device at once.
            self._calls.clear()
            return None

    def _score_host(self, poses: np.ndarray, ranges: np.ndarray, out: Any) -> np.ndarray | None:
        """Score poses and readings of the host; a call takes so little time that each check counts."""
        pipeline, count = self._pipeline, len(poses) if poses.ndim else 0
        size = pipeline.scanner.count
        if poses.shape != (count, 3) or ranges.shape != (size,) or not is_short(count, size) or not fits(count, size):
            return None
        if poses.dtype not in _FLOATS or ranges.dtype not in _FLOATS or not self._takes(count, out, (False, False)):
            return None
        key = (count, None, None, ranges.dtype)
        corners = self._corners(poses) if self._repeats(key) else None
        if corners is None or (pipeline.context.temperature < 1 and not self._has_range(ranges)):
            return None
        result = np.empty(count, pipeline.real) if out is None else out
        try:
            kept = self._calls.get(key)
            if kept is None:
                kept = PackedCall(pipeline, self._lock, count, ranges.dtype, corners), None
                self._calls.keep(key, kept)
            kept[0].score(poses, ranges, result, corners)
        except MemoryError:
            # The buffers of both kinds of calls may not fit the device at once.
            self._calls.clear()
            return None
        return self._delivered(kept[0], ranges, result)

    def _kinds(self, poses: Any, ranges: Any) -> tuple[bool, bool] | None:
        """Return whether poses and readings are on the device; None for arrays that the ordinary call must read."""
        kinds = []
        for array in (poses, ranges):
            if type(array) is np.ndarray:
                if array.dtype not in _FLOATS:
                    return None
                kinds.append(False)
            elif self._pipeline.backend.reads(array) and arrays.on_device(array):
                kinds.append(True)
            else:
                return None
        # The first scans are inspected on the host.
        return None if kinds[1] and self._pipeline.rules.first_scans.left else (kinds[0], kinds[1])

    def _adopted(self, poses: Any, ranges: Any, kinds: tuple[bool, bool]) -> _Adoption | None:
        """Return the types of arrays and their buffers; None for arrays that the ordinary call must refuse."""
        backend, single = self._pipeline.backend, _FLOATS[0]
        kind: np.dtype | None = None
        buffer, owner = None, None
        try:
            if kinds[0]:
                buffer, _, is_single, owner = arrays.adopt_poses(poses, backend, "poses")
                kind = single if is_single else _DOUBLE
            if not kinds[1]:
                return (kind, None, ranges.dtype), (buffer, None), (owner,)
            adopted = arrays.adopt_readings(ranges, backend, (self._pipeline.scanner.count,), in_place=False)
        except (TypeError, ValueError):
            return None
        return (kind, adopted.dtype, adopted.dtype), (buffer, adopted.buffer), (owner, adopted)

    def _scored(self, poses: Any, ranges: Any, out: Any, count: int, there: _Adoption, corners: Corners | None) -> Any:
        """Score poses; None where one of them is not finite."""
        pipeline, backend = self._pipeline, self._pipeline.backend
        kinds, buffers, _ = there
        kept = self._calls.get((count, *kinds))
        result = Result(poses, out, (count,), pipeline.real, backend, on_device=kinds[0] is not None)
        if kept is None:
            made = _There(backend, count, pipeline.scanner.count, kinds[:2], pipeline.real)
            packed = PackedCall(pipeline, self._lock, count, kinds[2], corners, **made.given)
            kept = self._calls.keep((count, *kinds), (packed, made))
        call, places = kept
        assert places is not None
        places.take(*buffers)
        host = [None if buffer is not None else array for array, buffer in zip((poses, ranges), buffers, strict=True)]
        flat = None if kinds[0] is not None else result.flat
        if not call.score(host[0], host[1], flat, corners, functools.partial(places.deliver, result.flat)):
            return None
        return self._delivered(call, ranges, result.user_array())

    def _delivered(self, call: PackedCall, ranges: Any, result: Any) -> Any:
        """Note a call that has succeeded, and return its result."""
        self.last, rules = call, self._pipeline.rules
        if rules.first_scans.left:
            rules.first_scans.look_at("ranges", ranges[None], rules.map_size)
        return result

    def _takes(self, count: int, out: Any, kinds: tuple[bool, bool]) -> bool:
        """Return whether results can be written."""
        if out is None or kinds[0]:
            return True
        usable = type(out) is np.ndarray and out.dtype == self._pipeline.real and out.shape == (count,)
        return usable and out.flags.c_contiguous and out.flags.writeable

    def _repeats(self, key: tuple[Any, ...]) -> bool:
        """Count a call of a size, and return whether the size has occurred often."""
        seen = self._seen.get(key) or 0
        if seen < _BEFORE:
            self._seen.keep(key, seen + 1)
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
