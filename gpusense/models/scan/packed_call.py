"""Calls of few particles on a GPU: a recorded program, with the copies of its inputs and of its result.

Arrays of the host go to the device as one array, and results come back as one: a copy of few numbers takes as long as a
launch, and the device classes a scan faster than the host. On CUDA, copies and launches form one graph. Arrays on the
device are used in place by bound calls, and copied to the slots of the program by ordinary calls that repeat a size, as
each of these has other arrays.
"""

from __future__ import annotations

import math
import threading
from typing import Any, NamedTuple

import numpy as np

from gpusense.backends import Backend, arrays
from gpusense.backends.arrays import Result
from gpusense.backends.workspace import ProgramCache, Workspace
from gpusense.models.poses import corners_of
from gpusense.models.scan.bound import RecordedCall
from gpusense.models.scan.pipeline import FLOATS, ScanPipeline
from gpusense.models.scan.tiles import LEAST_ORDERED
from gpusense.world.scanner import classify_ranges
from gpusense.world.windows import Corners

# Largest size that is copied with the launches [bytes]; longer arrays take the ordinary call.
LARGEST = 256 << 10
# Largest map of which a short call makes the whole table [cells].
MOST_CELLS = 1 << 22
_DOUBLE, _INT = np.dtype(np.float64), np.dtype(np.int32)
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
    """Arrays that are copied as one: the packed array and its parts on the host (``views``) and on the device."""

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
    """The recorded program of a number of poses, with the copies of its inputs and of its result.

    Each of poses, ranges (``inputs``) and result (``out``) is None for an array of the host, a type for arrays of the
    device that are copied, or an array of the device that is used in place. Poses and readings of the host are float64
    on the device, exact for float32. Limits of readings are rounded to ``limits``, the precision of the readings, as on
    the host. ``corners``: of the box of the first poses; None for the table of the whole map.
    """

    def __init__(
        self, pipeline: ScanPipeline, lock: threading.Lock, count: int, inputs: tuple[Any, Any], out: Any,
        limits: np.dtype | None, corners: Corners | None = None,
    ) -> None:  # fmt: skip
        self._backend = backend = pipeline.backend
        real, sizes = pipeline.real, (3 * count, pipeline.scanner.count)
        shapes = (count, 3), (pipeline.scanner.count,)
        in_host = [(size if kind is None else 0, _DOUBLE) for kind, size in zip(inputs, sizes, strict=True)]
        self._inputs = _Pack(backend, _DOUBLE, *in_host)
        self._outputs = _Pack(backend, real, (count if out is None else 0, real), (2, _INT))
        # The places of the inputs: host arrays, buffers with their bytes, or None for arrays that are used in place.
        self._slots: list[Any] = []
        there: list[Any] = []
        shown: list[Any] = []
        for kind, shape, view, part in zip(inputs, shapes, self._inputs.views, self._inputs.parts, strict=True):
            if kind is None:
                self._slots.append(view.reshape(shape))
                there.append(backend.wrap_external(part, shape, _DOUBLE))
            elif isinstance(kind, np.dtype):
                size = math.prod(shape)
                self._slots.append((backend.empty_external(size, kind), size * kind.itemsize))
                there.append(backend.wrap_external(self._slots[-1][0], shape, kind))
            else:
                self._slots.append(None)
                there.append(kind)
            shown.append(self._slots[-1] if kind is None else there[-1])
        self._shown, self._limits = shown, limits
        log_p, status = self._outputs.parts
        self._result, self._in_host = None, out is None
        if isinstance(out, np.dtype):
            log_p = backend.empty_external(count, real)
            self._result = log_p, count * real.itemsize
        if out is None or self._result is not None:
            out = backend.wrap_external(log_p, (count,), real)
        self._recorded = RecordedCall(pipeline, lock, there[0], there[1], out, status, limits, corners)
        self._space = Workspace(backend)

    def score(self, poses: Any, ranges: Any, out: Any, corners: Corners | None = None) -> bool:
        """Score poses that are not used in place; return False, and write nothing, if one is not finite."""
        backend, inputs, outputs = self._backend, self._inputs, self._outputs
        log_p, status = outputs.views
        with self._space:
            for slot, numbers in zip(self._slots, (poses, ranges), strict=True):
                if type(slot) is tuple:
                    backend.copy(numbers, *slot)
                elif slot is not None:
                    slot[...] = numbers
            if inputs.host.size:
                backend.upload(inputs.host, inputs.on_device, wait=False)
            self._recorded.begin(corners)
            backend.download(outputs.on_device, outputs.host, wait=not backend.in_batch)
            if self._result is not None:
                backend.copy(self._result[0], out, self._result[1])
            if backend.in_batch:
                backend.synchronize()
        if not status[0]:
            if self._in_host:
                out[...] = log_p
            return True
        status[...] = 0
        backend.upload(status, outputs.parts[1])
        return False

    @property
    def arrays(self) -> tuple[Any, Any]:
        """The poses and the readings of the last call; arrays of the host are copies, readings in their type."""
        poses, ranges = self._shown
        poses = poses.copy() if type(poses) is np.ndarray else poses
        return poses, ranges.astype(self._limits) if type(ranges) is np.ndarray else ranges

    def explain(self) -> str:
        """Return in one line how the launches are started."""
        return self._recorded.explain()


# ---- ordinary calls


class _Inputs(NamedTuple):
    """Poses and readings: types on the device (None on the host), arrays or buffers, owners, and type of limits."""

    kinds: tuple[np.dtype | None, np.dtype | None]
    arrays: tuple[Any, Any]
    owners: tuple[Any, ...]
    limits: np.dtype


class PackedCallCache:
    """Ordinary calls of a model that repeat a size of few particles, with the same bits as others.

    ``last``: the last call; None if it was not a short one.
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
    def of(pipeline: ScanPipeline) -> PackedCallCache | None:
        """Return the short calls of a model; None if its device or its options exclude them."""
        if not pipeline.backend.replays or host_task(pipeline) or pipeline.grid.cells.size > MOST_CELLS:
            return None
        certain = pipeline.specialize and pipeline.rules.separate and pipeline.context.possible
        return PackedCallCache(pipeline) if certain else None

    def score(self, poses: Any, ranges: Any, out: Any) -> Any:
        """Score poses by the readings of a scan, as ``log_likelihood``; None if the ordinary call must do it."""
        self.last = None
        pipeline, size = self._pipeline, self._pipeline.scanner.count
        shape: tuple[int, ...] = getattr(poses, "shape", ())
        if shape[1:] != (3,) or getattr(ranges, "shape", None) != (size,):
            return None
        count = shape[0]
        inputs = self._inputs(poses, ranges) if is_short(count, size) and fits(count, size) else None
        if inputs is None:
            return None
        there, in_host = inputs.kinds[0], inputs.kinds[0] is None
        key = (count, *inputs.kinds, inputs.limits)
        if not (out is None or not in_host or self._writes(count, out)) or not self._repeats(key):
            return None
        corners = self._corners(poses) if in_host else None
        if in_host and corners is None:
            return None
        if pipeline.context.temperature < 1:
            # Without a range that depends on the pose, the constant term is rounded differently.
            hit = None if inputs.kinds[1] is not None else classify_ranges(ranges, *pipeline.rules.limits)[0]
            if hit is None or not hit.any():
                return None
        try:
            result = None
            if in_host:
                target = np.empty(count, pipeline.real) if out is None else out
            else:
                result = Result(poses, out, (count,), pipeline.real, pipeline.backend, on_device=True)
                target = result.flat
            call = self._calls.get(key)
            if call is None:
                result_type = None if there is None else pipeline.real
                call = PackedCall(pipeline, self._lock, count, inputs.kinds, result_type, inputs.limits, corners)
                self._calls.keep(key, call)
            if not call.score(*inputs.arrays, target, corners):
                return None
        except MemoryError:
            # The buffers of both kinds of calls may not fit the device at once.
            self._calls.clear()
            return None
        self.last, rules = call, pipeline.rules
        if rules.first_scans.left:
            rules.first_scans.look_at("ranges", ranges[None], rules.map_size)
        return target if result is None else result.user_array()

    def _inputs(self, poses: Any, ranges: Any) -> _Inputs | None:
        """Return the inputs of a call; None for arrays that the ordinary call must read or refuse."""
        if type(poses) is np.ndarray and type(ranges) is np.ndarray:
            usable = poses.dtype in FLOATS and ranges.dtype in FLOATS
            return _Inputs((None, None), (poses, ranges), (), ranges.dtype) if usable else None
        backend = self._pipeline.backend
        for array in (poses, ranges):
            if type(array) is np.ndarray:
                if array.dtype not in FLOATS:
                    return None
            elif not (backend.reads(array) and arrays.on_device(array)):
                return None
        kind, taken, owner = None, poses, None
        try:
            if type(poses) is not np.ndarray:
                taken, _, single, owner = arrays.adopt_poses(poses, backend, "poses")
                kind = FLOATS[0] if single else _DOUBLE
            if type(ranges) is np.ndarray:
                return _Inputs((kind, None), (taken, ranges), (owner,), ranges.dtype)
            # The first scans are inspected on the host.
            if self._pipeline.rules.first_scans.left:
                return None
            adopted = arrays.adopt_readings(ranges, backend, (self._pipeline.scanner.count,), in_place=False)
        except (TypeError, ValueError):
            return None
        return _Inputs((kind, adopted.dtype), (taken, adopted.buffer), (owner, adopted), adopted.dtype)

    def _writes(self, count: int, out: Any) -> bool:
        """Return whether results can be written to an array of the host."""
        usable = type(out) is np.ndarray and out.dtype == self._pipeline.real and out.shape == (count,)
        return usable and out.flags.c_contiguous and out.flags.writeable

    def _repeats(self, key: tuple[Any, ...]) -> bool:
        """Count a call of a size, and return whether the size has occurred often."""
        seen = self._seen.get(key) or 0
        if seen < _BEFORE:
            self._seen.keep(key, seen + 1)
        return seen >= _BEFORE

    def _corners(self, poses: np.ndarray) -> Corners | None:
        """Return corners of the box of poses; None where one is not finite."""
        low, high = arrays.bounds_of(np.asarray(poses, np.float64))
        if not all(map(math.isfinite, (*low, *high))):
            return None
        return corners_of((low, high))
