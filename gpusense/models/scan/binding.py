"""``bind`` of a model: which way a bound call goes, and the ways of arrays in host memory.

A call that waits is the ordinary one, but for NumPy arrays of few particles on a GPU: they are copied to the device and
the launches of ``bound.DeviceCall`` follow, so that readings are classed there and nothing is looked at on the host.
With CUDA copies and launches are one graph.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from gpusense._util import checks
from gpusense.backends import arrays
from gpusense.backends.workspace import Workspace
from gpusense.models.cloud import LEAST_ORDERED
from gpusense.models.scan.bound import BoundCall, DeviceCall

if TYPE_CHECKING:
    from gpusense.models.scan.model import ScanModel

# Cells of a map whose table is made as a whole for them.
_MOST_CELLS = 1 << 22
# Bytes of what is copied with the launches; more is copied in the ordinary way.
_LARGEST = 256 << 10
_DOUBLE, _INT = np.dtype(np.float64), np.dtype(np.int32)
# Bytes between the beginnings of arrays that are copied as one: every device can begin there.
_ALIGNED = 1024


def bind(model: ScanModel, poses: Any, ranges: Any, out: Any) -> BoundCall:
    """See ``ScanModel.bind``."""
    for name, given in (("poses", poses), ("ranges", ranges)):
        if not (isinstance(given, np.ndarray) or hasattr(given, "__dlpack__") or arrays.on_device(given)):
            raise TypeError(f"{name}: must be an array, whose numbers every call reads anew, got {checks.show(given)}")
        if type(given).__module__.startswith("jax"):
            raise TypeError(f"{name}: must be an array whose numbers can change, got one of JAX, where none do")
    there = arrays.on_device(poses) and arrays.on_device(ranges)
    # Readings as other programs see them are made on the host, and poses are placed there where float64 is missing. On
    # processors, scans prepared on the host are scored by kernels in vectors.
    if there and model.compat is None and model.device.float64 and model.device.kind == "gpu":
        return DeviceCall(model, poses, ranges, out)
    host = _HostCall(model, poses, ranges, out)
    if model.compat is None and host.is_short():
        try:
            return _StagedCall(host)
        except MemoryError:
            # The ordinary call needs but a part of the map's table.
            pass
    return host


class _HostCall(BoundCall):
    """The ordinary way."""

    waits = True

    def __init__(self, model: ScanModel, poses: Any, ranges: Any, out: Any) -> None:
        backend, beams = model._backend, model.scanner.count
        if arrays.on_device(poses):
            count = arrays.adopt_poses(poses, backend, "poses")[1]
        else:
            count = _shape_of("poses", poses, ("N", 3))[0]
        if arrays.on_device(ranges):
            arrays.adopt_readings(ranges, backend, beams, in_place=False)
        else:
            _shape_of("ranges", ranges, (beams,))
        arrays.check_out(out, (count,), model._real, poses, backend)
        if out is None and arrays.on_device(poses):
            out = arrays.lent(poses, backend, arrays.blank(backend, count, model._real), (count,), model._real)
        elif out is None:
            out = arrays.like(poses, np.empty(count, model._real))
        self.out, self._model, self._given = out, model, (poses, ranges)

    def __call__(self, stream: Any = None) -> Any:
        """See BoundCall.__call__."""
        if stream is not None:
            raise TypeError(f"stream: must be None for a call that waits, got {checks.show(stream)}")
        return self._model.log_likelihood(*self._given, out=self.out)

    def check(self) -> None:
        """See BoundCall.check."""

    def is_short(self) -> bool:
        """Whether arrays are NumPy's, all is small, and the device gains by starting launches that it knows."""
        backend = self._model._backend
        if not getattr(backend, "stages", False) or not backend.info.float64:
            return False
        poses, ranges = self._given
        given, reals = (poses, ranges, self.out), (np.float32, np.float64)
        short = all(type(a) is np.ndarray and a.dtype in reals for a in given)
        short = short and _DOUBLE.itemsize * (poses.size + ranges.size) <= _LARGEST
        return short and self._model.grid.cells.size <= _MOST_CELLS and 0 < len(poses) * len(ranges) < LEAST_ORDERED[0]


class _Pack:
    """Arrays that are copied as one, on the host and on the device.

    Attributes:
        host: What is copied.
        there: Where it is on the device.
        views: The arrays on the host.
        parts: The arrays on the device.
    """

    def __init__(self, backend: Any, dtype: np.dtype, *arrays: tuple[int, np.dtype]) -> None:
        begins, size = [], 0
        for count, own in arrays:
            begins.append(size)
            size += -(-count * own.itemsize // _ALIGNED) * _ALIGNED
        self.host = np.zeros(size // dtype.itemsize, dtype)
        self.there = backend.upload(self.host, backend.blank(self.host.size, dtype))
        numbers = self.host.view(np.uint8)
        self.views, self.parts = [], []
        for begin, (count, own) in zip(begins, arrays, strict=True):
            self.views.append(numbers[begin : begin + count * own.itemsize].view(own))
            self.parts.append(backend.part(self.there, begin // own.itemsize, count, own))


class _StagedCall(BoundCall):
    """A call of few particles: what it is given goes to the device as one array, and what it finds comes back as one.

    A copy of few numbers takes as long as a launch. Poses and readings are float64 on the device, which keeps float32
    as it is; limits of readings are rounded to the readings' own precision, as on the host.
    """

    waits = True

    def __init__(self, host: _HostCall) -> None:
        self._host, self.out, (self._poses, self._ranges) = host, host.out, host._given
        model = host._model
        self._backend = backend = cast(Any, model._backend)
        count, readings = len(self._poses), len(self._ranges)
        self._inputs = _Pack(backend, _DOUBLE, (3 * count, _DOUBLE), (readings, _DOUBLE))
        self._outputs = _Pack(backend, model._real, (count, model._real), (2, _INT))
        poses, ranges = self._inputs.parts
        found, verdict = self._outputs.parts
        self._device = DeviceCall(
            model, backend.lend(poses, (count, 3), _DOUBLE), backend.lend(ranges, (readings,), _DOUBLE),
            backend.lend(found, (count,), model._real), verdict, self._ranges.dtype,
        )  # fmt: skip
        self._space, self._lock = Workspace(backend), threading.Lock()

    def __call__(self, stream: Any = None) -> Any:
        """See BoundCall.__call__."""
        if stream is not None:
            return self._host(stream)
        backend, given, outputs = self._backend, self._inputs, self._outputs
        (poses, ranges), (found, verdict) = given.views, outputs.views
        with self._lock:
            poses.reshape(self._poses.shape)[...] = self._poses
            ranges[...] = self._ranges
            try:
                with self._space:
                    backend.upload(given.host, given.there, wait=False)
                    self._device.begin()
                    backend.download(outputs.there, outputs.host, wait=not self._gathers())
                    if self._gathers():
                        backend.synchronize()
            except MemoryError:
                # The whole table of a map that has changed; the ordinary call needs but a part of it.
                return self._host()
            if not verdict[0]:
                self.out[...] = found
                return self.out
            verdict[...] = 0
            backend.upload(verdict, outputs.parts[1])
        # It says which pose is not finite.
        return self._host()

    def _gathers(self) -> bool:
        """Whether copies wait for others, to be done in one go."""
        return hasattr(self._backend, "mark") and self._backend.mark() is not None

    def check(self) -> None:
        """See BoundCall.check."""


def _shape_of(name: str, given: Any, shape: tuple[int | str, ...]) -> tuple[int, ...]:
    """The shape of an array in host memory; its numbers are looked at by each call."""
    found = np.shape(cast(Any, arrays.to_host(given, name)))
    if len(found) != len(shape) or any(isinstance(n, int) and n != m for n, m in zip(shape, found, strict=True)):
        raise ValueError(f"{name}: shape must be {checks.shape_text(shape)}, got {checks.shape_text(found)}")
    return found
