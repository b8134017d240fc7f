"""``bind`` of a model: the choice among bound calls, and those of arrays in host memory.

A call that waits is the ordinary one, except for NumPy arrays of few particles on a GPU. They are copied to the device,
and the recording of ``bound.DeviceCall`` follows: the device classes the readings, and the host inspects nothing. With
CUDA copies and launches are one graph.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, cast

import numpy as np

from gpusense._util import checks, masks
from gpusense.backends import Backend, arrays
from gpusense.backends.results import Result
from gpusense.backends.workspace import Workspace
from gpusense.models.scan.bound import BoundCall, DeviceCall
from gpusense.models.scan.pipeline import ScanPipeline
from gpusense.models.scan.tiles import LEAST_ORDERED

# Most cells of a map for which a short call makes the whole table.
_MOST_CELLS = 1 << 22
# Most bytes that are copied with the launches; longer arrays take the ordinary call.
_LARGEST = 256 << 10
_DOUBLE, _INT = np.dtype(np.float64), np.dtype(np.int32)
# Alignment of arrays that are copied as one [bytes], enough for every device.
_ALIGNED = 1024


def bind(
    pipeline: ScanPipeline, lock: threading.Lock, score: Callable[..., Any], poses: Any, ranges: Any, out: Any
) -> BoundCall:
    """Bind arrays; see ``ScanModel.bind``.

    Args:
        pipeline: The stages of the model.
        lock: Held while the model's buffers are in use.
        score: ``log_likelihood`` of the model.
        poses: (N, 3) poses.
        ranges: (K,) readings.
        out: The array for the log-likelihoods, or None.
    """
    for name, array in (("poses", poses), ("ranges", ranges)):
        if not (isinstance(array, np.ndarray) or hasattr(array, "__dlpack__") or arrays.on_device(array)):
            raise TypeError(f"{name}: must be an array, whose numbers every call reads anew, got {checks.show(array)}")
        if type(array).__module__.startswith("jax"):
            raise TypeError(f"{name}: must be an array whose numbers can change, got one of JAX, where none do")
    in_host = [name for name, array in (("poses", poses), ("ranges", ranges)) if not arrays.on_device(array)]
    obstacle = _host_task(pipeline)
    if not in_host and not obstacle and pipeline.backend.info.kind == "gpu":
        return DeviceCall(pipeline, lock, poses, ranges, out)
    host = _HostCall(pipeline, score, poses, ranges, out)
    if len(in_host) == 1:
        obstacle = obstacle or f"{in_host[0]} are in host memory"
    elif not in_host:
        obstacle = obstacle or "processors score scans that the host prepares"
    host.reason = obstacle or host.long_reason()
    if not host.reason:
        try:
            return _StagedCall(host, lock)
        except MemoryError:
            # The ordinary call needs but a part of the map's table.
            host.reason = "the table of the whole map does not fit the device"
    return host


def _host_task(pipeline: ScanPipeline) -> str:
    """Return the preparation that only the host can do, as a clause; empty where the device can do all of it."""
    if pipeline.setting.weights.is_peer:
        return "the host classes the readings for another program's weights"
    if not pipeline.backend.info.float64:
        return "the host places the poses, as the device has no float64"
    return ""


class _HostCall(BoundCall):
    """An ordinary call of ``log_likelihood``.

    Attributes:
        reason: Why no program is recorded.
    """

    waits = True
    reason = ""

    def __init__(self, pipeline: ScanPipeline, score: Callable[..., Any], poses: Any, ranges: Any, out: Any) -> None:
        backend, real, beams = pipeline.backend, pipeline.real, pipeline.scanner.count
        on_device = arrays.on_device(poses)
        if on_device:
            count = arrays.adopt_poses(poses, backend, "poses")[1]
        else:
            count = _shape_of("poses", poses, ("N", 3))[0]
        if arrays.on_device(ranges):
            arrays.adopt_readings(ranges, backend, beams, in_place=False)
        else:
            _shape_of("ranges", ranges, (beams,))
        self.out = Result(poses, out, (count,), real, backend, on_device=on_device).user_array()
        self.pipeline, self.arrays, self._score = pipeline, (poses, ranges), score

    def __call__(self, stream: Any = None) -> Any:
        """See BoundCall.__call__."""
        if stream is not None:
            raise TypeError(f"stream: must be None for a call that waits, got {checks.show(stream)}")
        return self._score(*self.arrays, out=self.out)

    def explain(self) -> str:
        """See BoundCall.explain."""
        return f"the ordinary call: {self.reason}"

    def check(self) -> None:
        """See BoundCall.check."""

    def long_reason(self) -> str:
        """Return why arrays in host memory are not copied with a recorded program; empty for those of a short call."""
        poses, ranges = self.arrays
        if not self.pipeline.backend.replays:
            return f"{self.pipeline.backend.info.selection} starts launches fast enough without a recording"
        if not all(type(a) is np.ndarray and a.dtype in (np.float32, np.float64) for a in (poses, ranges, self.out)):
            return "only NumPy arrays of float32 or float64 are copied with a recorded program"
        if _DOUBLE.itemsize * (poses.size + ranges.size) > _LARGEST:
            return f"poses and ranges take more than {_LARGEST >> 10} KiB"
        if self.pipeline.grid.cells.size > _MOST_CELLS:
            return f"the map has more than {_MOST_CELLS} cells"
        if not 0 < len(poses) * len(ranges) < LEAST_ORDERED[0]:
            return f"{len(poses)} poses times {len(ranges)} readings are no short call"
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


class _StagedCall(BoundCall):
    """A call of few particles: inputs go to the device as one array, and results come back as one.

    A copy of few numbers takes as long as a launch. Poses and readings are float64 on the device, which is
    exact for float32. Limits of readings are rounded to the precision of the readings, as on the host.
    """

    waits = True

    def __init__(self, host: _HostCall, lock: threading.Lock) -> None:
        self._host, self.out, (self._poses, self._ranges) = host, host.out, host.arrays
        pipeline = host.pipeline
        self._backend = backend = pipeline.backend
        count, readings, real = len(self._poses), len(self._ranges), pipeline.real
        self._inputs = _Pack(backend, _DOUBLE, (3 * count, _DOUBLE), (readings, _DOUBLE))
        self._outputs = _Pack(backend, real, (count, real), (2, _INT))
        poses, ranges = self._inputs.parts
        log_p, status = self._outputs.parts
        self._device = DeviceCall(
            pipeline, lock, backend.lend(poses, (count, 3), _DOUBLE), backend.lend(ranges, (readings,), _DOUBLE),
            backend.lend(log_p, (count,), real), status, self._ranges.dtype,
        )  # fmt: skip
        self._space, self._lock = Workspace(backend), threading.Lock()

    def __call__(self, stream: Any = None) -> Any:
        """See BoundCall.__call__."""
        if stream is not None:
            return self._host(stream)
        backend, inputs, outputs = self._backend, self._inputs, self._outputs
        (poses, ranges), (log_p, status) = inputs.views, outputs.views
        with self._lock:
            poses.reshape(self._poses.shape)[...] = self._poses
            ranges[...] = self._ranges
            try:
                with self._space:
                    backend.upload(inputs.host, inputs.on_device, wait=False)
                    self._device.begin()
                    backend.download(outputs.on_device, outputs.host, wait=not backend.in_batch)
                    if backend.in_batch:
                        backend.synchronize()
            except MemoryError:
                # This call would need the whole table of a changed map; the ordinary call needs only a part.
                return self._host()
            if not status[0]:
                self.out[...] = log_p
                return self.out
            status[...] = 0
            backend.upload(status, outputs.parts[1])
        # Its message names the pose that is not finite.
        return self._host()

    def explain(self) -> str:
        """See BoundCall.explain."""
        return f"NumPy arrays are copied with each call: {self._device.explain()}"

    def check(self) -> None:
        """See BoundCall.check."""


def _shape_of(name: str, value: Any, shape: tuple[int | str, ...]) -> tuple[int, ...]:
    """Return the shape of an array in host memory; each call reads its numbers anew."""
    actual = np.shape(cast(Any, arrays.to_host(masks.filled(value), name)))
    if len(actual) != len(shape) or any(isinstance(n, int) and n != m for n, m in zip(shape, actual, strict=True)):
        raise ValueError(f"{name}: shape must be {checks.shape_text(shape)}, got {checks.shape_text(actual)}")
    return actual
