"""Calls of few particles on a GPU: a recorded program, with the copies of its inputs and of its result.

Arrays of the host go to the device as one array, and results come back as one: a copy of few numbers takes as long as a
launch, and the device classes a scan faster than the host. On CUDA, copies and launches form one graph. Arrays on the
device are used in place by bound calls, and by ordinary calls that repeat their addresses; other arrays are copied to
the slots of a program of their size.
"""

from __future__ import annotations

import functools
import math
import threading
from collections.abc import Callable
from typing import Any

import numpy as np

from gpusense.backends import arrays
from gpusense.backends.arrays import FLOATS, Result
from gpusense.backends.base import Adopted
from gpusense.backends.workspace import Packed, RepeatCache
from gpusense.models.scan.bound import RecordedCall
from gpusense.models.scan.pipeline import ScanPipeline
from gpusense.models.scan.tiles import LEAST_ORDERED
from gpusense.world.scanner import classify_ranges

# Largest size of the host's arrays that are copied with the launches [bytes]; longer ones take the ordinary call.
LARGEST = 256 << 10
# Largest map of which a short call makes the whole table [cells].
MOST_CELLS = 1 << 22
_DOUBLE, _INT = np.dtype(np.float64), np.dtype(np.int32)
# Numbers of sizes and of places of short calls that are kept; ordinary calls before the first short one; calls after
# which places make room for others; and latest addresses of an argument that are known.
_MOST_SIZES, _MOST_PLACES, _BEFORE, _PATIENCE, _KNOWN = 8, 16, 2, 4096, 4


def fits(poses: Any, readings: int) -> bool:
    """Return whether the arrays of the host are few enough numbers to be copied with the launches."""
    return _DOUBLE.itemsize * ((3 * len(poses) if type(poses) is np.ndarray else 0) + readings) <= LARGEST


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


class PackedCall:
    """The recorded program of a number of poses, with the copies of its inputs and of its result.

    Each of poses, ranges (``inputs``) and result (``out``) is None for an array of the host, a type for arrays of the
    device that are copied, or an array of the device that is used in place. Poses and readings of the host are float64
    on the device, exact for float32. Limits of readings are rounded to ``limits``, the precision of the readings, as on
    the host. The table is that of the whole map, so that no call needs the bounds of its poses.
    """

    def __init__(
        self, pipeline: ScanPipeline, lock: threading.Lock, count: int, inputs: tuple[Any, Any], out: Any,
        limits: np.dtype | None,
    ) -> None:  # fmt: skip
        backend = self._backend = pipeline.backend
        self._limits = limits
        real, shapes = pipeline.real, ((count, 3), (pipeline.scanner.count,))
        sizes = [0 if kind is not None else math.prod(one) for kind, one in zip(inputs, shapes, strict=True)]
        packed = Packed(backend, sizes)
        results = Packed(backend, [count if out is None else 0, _INT.itemsize * 2 // real.itemsize], real)
        # By identity: arrays of some libraries compare their numbers.
        given = packed.size if any(one is None for one in inputs) else 0
        self._exchange = backend.exchange(packed.buffer, given, results.buffer, results.size, real)
        # The places of the inputs: arrays of the host, buffers with their bytes, or None for arrays in place.
        self._slots: list[Any] = []
        there: list[Any] = []
        for kind, shape, span, part in zip(inputs, shapes, packed.spans, packed.parts, strict=True):
            if kind is None:
                self._slots.append(self._exchange.given[span].reshape(shape))
                kind = backend.view(part, shape, _DOUBLE)
            elif isinstance(kind, np.dtype):
                size = math.prod(shape)
                self._slots.append((backend.empty_external(size, kind), size * kind.itemsize))
                kind = backend.view(self._slots[-1][0], shape, kind)
            else:
                self._slots.append(None)
            there.append(kind)
        self._there = there
        self._log_p, self._flag = results.spans
        self._status = backend.part(results.parts[1], 0, 2, _INT)
        self._result, self._in_host = None, out is None
        if isinstance(out, np.dtype):
            self._result = backend.empty_external(count, real), count * real.itemsize
            out = backend.view(self._result[0], (count,), real)
        elif out is None:
            out = backend.view(results.parts[0], (count,), real)
        self._recorded = RecordedCall(pipeline, lock, there[0], there[1], out, self._status, limits)

    def score(self, poses: Any, ranges: Any, out: Any, meanwhile: Callable[[], None] | None = None) -> Any:
        """Score poses; return ``out``, or a new array of the host without it; None if a pose is not finite.

        No array of the host is written where a pose is not finite. ``meanwhile``: called while the device works.
        """
        exchange = self._exchange
        exchange.begin()
        recording = self._recorded.recording
        for slot, numbers in zip(self._slots, (poses, ranges), strict=True):
            if type(slot) is tuple:
                self._backend.copy(numbers.buffer, *slot)
            elif slot is not None:
                slot[...] = numbers
        exchange.start(recording)
        if self._result is not None:
            self._backend.copy(self._result[0], out, self._result[1])
        if meanwhile is not None:
            meanwhile()
        results = exchange.finish()
        status = results[self._flag].view(_INT)
        if status[0]:
            self._backend.upload(np.zeros(2, _INT), self._status)
            return None
        if not self._in_host:
            return out
        if out is None:
            return results[self._log_p]
        out[...] = results[self._log_p]
        return out

    def shown(self, poses: Any, ranges: Any) -> tuple[Any, Any]:
        """Return the operands of the last call: copies of arrays of the host, readings in their type."""
        at, readings = (
            given if slot is None else there if type(slot) is tuple else slot.copy()
            for slot, there, given in zip(self._slots, self._there, (poses, ranges), strict=True)
        )
        return at, readings.astype(self._limits) if type(self._slots[1]) is np.ndarray else readings

    def explain(self) -> str:
        """Return in one line how the launches are started."""
        return self._recorded.explain(self._exchange.explain)


# ---- ordinary calls


class PackedCallCache:
    """Ordinary calls of a model that repeat a size of few particles, with the same bits as others.

    Arrays of the device at addresses that repeat are used in place, others are copied.

    Attributes:
        last: Function that returns poses and readings of the last call; None if it was not a short one.
    """

    def __init__(self, pipeline: ScanPipeline) -> None:
        self._pipeline = pipeline
        self.last: Callable[[], tuple[Any, Any]] | None = None
        # Keyed by size and types; and by size, types and addresses of arrays in place.
        self._sizes = RepeatCache[PackedCall](_MOST_SIZES, _BEFORE)
        self._places = RepeatCache[PackedCall](_MOST_PLACES, _BEFORE, _PATIENCE)
        # The latest addresses of poses, ranges and results.
        self._known: tuple[list[int], ...] = ([], [], [])
        # The memory of the next result on the device, with its key, made while the device worked.
        self._ahead: tuple[Any, Result] | None = None
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
        if not (is_short(count, size) and fits(poses, size)):
            return None
        at, readings = self._operand(poses, "poses"), self._operand(ranges, "ranges")
        if at is None or readings is None:
            return None
        in_host, rules = type(at) is np.ndarray, pipeline.rules
        if pipeline.context.temperature < 1 or rules.first_scans.left:
            if isinstance(readings, Adopted):
                # The host inspects them.
                ranges = pipeline.backend.download(readings.buffer, np.empty(size, readings.dtype))
            if pipeline.context.temperature < 1 and not classify_ranges(ranges, *rules.limits)[0].any():
                # The ordinary call rounds the constant term differently if no reading depends on the pose.
                return None
        try:
            result, target = None, None
            if not in_host or out is not None:
                result = self._result(poses, out, count, on_device=not in_host)
                target = result.flat
            # Libraries of CUDA reuse the memory of earlier results.
            in_place = not in_host and (out is not None or pipeline.backend.info.graphs)
            call = self._call((at, readings), target, in_place=in_place)
            if call is None:
                return None
            ahead = out is None and not in_host and pipeline.backend.ahead(poses) is not None
            meanwhile = functools.partial(self._allocate, poses, count) if ahead else None
            scored = call.score(at, readings, target, meanwhile)
            if scored is None:
                return None
        except MemoryError:
            # The buffers of both kinds of calls may not fit the device at once.
            self._sizes.clear()
            self._places.clear()
            self._ahead = None
            return None
        self.last = functools.partial(call.shown, poses, ranges)
        if rules.first_scans.left:
            rules.first_scans.look_at("ranges", ranges[None], rules.map_size)
        return scored if result is None else result.user_array()

    def _result(self, poses: Any, out: Any, count: int, *, on_device: bool) -> Result:
        """Return the memory of a result: ``out``, or memory that the last call has allocated, or new memory."""
        ahead, self._ahead = self._ahead, None
        if ahead is not None and out is None and ahead[0] == (count, self._pipeline.backend.ahead(poses)):
            return ahead[1]
        return Result(poses, out, (count,), self._pipeline.real, self._pipeline.backend, on_device=on_device)

    def _allocate(self, poses: Any, count: int) -> None:
        """Allocate the next result on the device."""
        key = count, self._pipeline.backend.ahead(poses)
        self._ahead = key, self._result(poses, None, count, on_device=True)

    def _operand(self, array: Any, name: str) -> np.ndarray | Adopted | None:
        """Return an array of the host or of the device; None if the ordinary call must read or refuse it."""
        if type(array) is np.ndarray:
            return array if array.dtype in FLOATS else None
        backend = self._pipeline.backend
        if not (backend.reads(array) and arrays.on_device(array)):
            return None
        try:
            adopted = backend.adopt(array, name)
        except (TypeError, ValueError):
            return None
        return adopted if adopted.dtype in FLOATS and adopted.strides is None else None

    def _call(
        self, operands: tuple[np.ndarray | Adopted, np.ndarray | Adopted], target: Any, *, in_place: bool
    ) -> PackedCall | None:
        """Return the call of poses and ranges, recorded once it repeats; ``in_place``: whether results may be."""
        at, readings = operands
        if type(at) is np.ndarray and type(readings) is np.ndarray:
            key: tuple[Any, ...] = (at.shape[0], None, None, readings.dtype, None, None, None)
            return self._sizes.found(key, functools.partial(self._recorded, key, [None, None], target))
        there = [None if isinstance(one, np.ndarray) else one for one in operands]
        kinds = [None if one is None else one.dtype for one in there]
        size = (at.shape[0], *kinds, readings.dtype)
        buffers = [*(None if one is None else one.buffer for one in there), target if in_place else None]
        # Copy arrays at addresses that change, such as new scans, and results that the user keeps.
        places = tuple(map(self._place, buffers, self._known))
        for key in dict.fromkeys([(*size, *places), (*size, None, None, None)]):
            cache = self._places if any(key[-3:]) else self._sizes
            call = cache.found(key, functools.partial(self._recorded, key, there, target))
            if call is not None:
                return call
        return None

    def _place(self, buffer: Any, known: list[int]) -> int | None:
        """Return the address of an array that is used in place; None for one that is copied, and note its address."""
        if buffer is None:
            return None
        address = self._pipeline.backend.address(buffer)
        if address in known:
            return address
        known.append(address)
        del known[:-_KNOWN]
        return None

    def _recorded(self, key: tuple[Any, ...], there: list[Adopted | None], target: Any) -> PackedCall:
        """Return a new call, which uses the arrays of the device in place that its key names."""
        count, *kinds, limits, at, readings, result = key
        view, real = self._pipeline.backend.view, self._pipeline.real
        inputs = [
            kind if place is None or one is None else view(one.buffer, one.shape, one.dtype)
            for one, kind, place in zip(there, kinds, (at, readings), strict=True)
        ]
        out = None if there[0] is None else real if result is None else view(target, (count,), real)
        return PackedCall(self._pipeline, self._lock, count, (inputs[0], inputs[1]), out, limits)
