"""``bind`` of a model: the choice among bound calls, and bound calls of arrays in host memory.

A call that waits is the ordinary one, except for NumPy arrays of few particles on a GPU. They are copied to the device,
as :mod:`.packed_call` describes. The choice names every kind of call, so it belongs above :mod:`.bound`; filters make
those calls themselves.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, cast

import numpy as np

from gpusense._util import checks, masks
from gpusense.backends import arrays
from gpusense.backends.results import Result
from gpusense.models.scan.bound import BoundCall, DeviceCall
from gpusense.models.scan.packed_call import LARGEST, MOST_CELLS, PackedCall, fits, host_task, is_short
from gpusense.models.scan.pipeline import ScanPipeline
from gpusense.tables.world_index import WorldIndex
from gpusense.tables.worlds import Worlds


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
    _check_bound(poses, ranges)
    in_host = [name for name, array in (("poses", poses), ("ranges", ranges)) if not arrays.on_device(array)]
    obstacle = host_task(pipeline)
    if not in_host and not obstacle and pipeline.backend.info.kind == "gpu":
        return DeviceCall(pipeline, lock, poses, ranges, out)
    host = _HostCall(pipeline, score, poses, ranges, out)
    if not in_host:
        obstacle = obstacle or "processors score scans that the host prepares"
    host.reason = obstacle or host.long_reason()
    if not host.reason:
        try:
            return _StagedCall(host, lock)
        except MemoryError:
            # The ordinary call needs only a part of the map's table.
            host.reason = "the table of the whole map does not fit the device"
    return host


def bind_worlds(
    pipeline: ScanPipeline, lock: threading.Lock, score: Callable[..., Any], worlds: Worlds, poses: Any, ranges: Any,
    world: Any, ignore: Any, out: Any,
) -> BoundCall:  # fmt: skip
    """Bind arrays of robots in many worlds; see ``ScanModel.bind``.

    Args:
        pipeline: The stages of the model.
        lock: Held while the model's buffers are in use.
        score: ``log_likelihood`` of the model.
        worlds: The worlds.
        poses: (N, 3) poses.
        ranges: (K,) or (N, K) readings.
        world: (N,) indices of worlds, or one for all.
        ignore: (N,) indices of shapes, one for all, or None.
        out: The array for the log-likelihoods, or None.
    """
    _check_bound(poses, ranges)
    backend, rules = pipeline.backend, pipeline.rules
    there = arrays.on_device(poses) and arrays.on_device(ranges)
    if not there or backend.info.kind != "gpu":
        return _WorldsCall(score, poses, ranges, world, ignore, out)
    if len(ranges.shape) == 2 and not (rules.choice.every and rules.separate and pipeline.context.possible):
        # Scans whose beams are chosen by their readings, or share rays, are prepared by the host.
        return _WorldsCall(score, poses, ranges, world, ignore, out)
    count = int(poses.shape[0])
    inside = WorldIndex(worlds, world, ignore, count, backend).resident(backend)
    return DeviceCall(pipeline, lock, poses, ranges, out, inside=inside)


def _check_bound(poses: Any, ranges: Any) -> None:
    """Refuse poses and ranges that are not arrays, or that cannot change."""
    for name, array in (("poses", poses), ("ranges", ranges)):
        if not (isinstance(array, np.ndarray) or hasattr(array, "__dlpack__") or arrays.on_device(array)):
            raise TypeError(f"{name}: must be an array, whose numbers every call reads anew, got {checks.show(array)}")
        if type(array).__module__.startswith("jax"):
            raise TypeError(f"{name}: must be an array whose numbers can change, got one of JAX, where none do")


class _WorldsCall(BoundCall):
    """An ordinary call of ``log_likelihood`` of a model of worlds."""

    waits = True

    def __init__(self, score: Callable[..., Any], poses: Any, ranges: Any, world: Any, ignore: Any, out: Any) -> None:
        self._score, self._arrays = score, (poses, ranges)
        self._options = dict(world=world, ignore=ignore)
        # The first call checks the arguments, and makes the result.
        self.out = score(poses, ranges, out=out, **self._options)

    def __call__(self, stream: Any = None) -> Any:
        if stream is not None:
            raise TypeError(f"stream: must be None for a call that waits, got {checks.show(stream)}")
        return self._score(*self._arrays, out=self.out, **self._options)

    def explain(self) -> str:
        return "the ordinary call: poses or ranges are in host memory, or the host prepares the scans"

    def check(self) -> None:
        """See BoundCall.check."""


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
            arrays.adopt_readings(ranges, backend, (beams,), in_place=False)
        else:
            _shape_of("ranges", ranges, (beams,))
        self.out = Result(poses, out, (count,), real, backend, on_device=on_device).user_array()
        self.pipeline, self.arrays, self._score = pipeline, (poses, ranges), score

    def __call__(self, stream: Any = None) -> Any:
        if stream is not None:
            raise TypeError(f"stream: must be None for a call that waits, got {checks.show(stream)}")
        return self._score(*self.arrays, out=self.out)

    def explain(self) -> str:
        return f"the ordinary call: {self.reason}"

    def check(self) -> None:
        """See BoundCall.check."""

    def long_reason(self) -> str:
        """Return why arrays in host memory are not copied with a recorded program; empty for arrays of a short call."""
        poses, ranges = self.arrays
        if not self.pipeline.backend.replays:
            return f"{self.pipeline.backend.info.selection} starts launches fast enough without a recording"
        here = [a for a in (poses, ranges, self.out) if not arrays.on_device(a)]
        if not all(type(a) is np.ndarray and a.dtype in (np.float32, np.float64) for a in here):
            return "only NumPy arrays of float32 or float64 are copied with a recorded program"
        if not fits(len(poses), len(ranges)):
            return f"poses and ranges take more than {LARGEST >> 10} KiB"
        if self.pipeline.grid.cells.size > MOST_CELLS:
            return f"the map has more than {MOST_CELLS} cells"
        if not is_short(len(poses), len(ranges)):
            return f"{len(poses)} poses times {len(ranges)} readings are no short call"
        return ""


class _StagedCall(BoundCall):
    """A call of few particles in NumPy arrays: inputs go to the device as one array, and results come back as one."""

    waits = True

    def __init__(self, host: _HostCall, lock: threading.Lock) -> None:
        self._host, self.out, (self._poses, self._ranges) = host, host.out, host.arrays
        count = len(self._poses)
        there = {
            name: array
            for name, array in (("poses", self._poses), ("ranges", self._ranges), ("out", self.out))
            if type(array) is not np.ndarray
        }
        limits = None if "ranges" in there else self._ranges.dtype
        self._packed = PackedCall(host.pipeline, lock, count, limits, **there)
        # Host arrays: every call copies their numbers.
        self._copied = [None if name in there else array for name, array in (
            ("poses", self._poses), ("ranges", self._ranges), ("out", self.out))]  # fmt: skip
        self._lock = threading.Lock()

    def __call__(self, stream: Any = None) -> Any:
        if stream is not None:
            return self._host(stream)
        try:
            with self._lock:
                if self._packed.score(*self._copied):
                    return self.out
        except MemoryError:
            # This call would need the whole table of a changed map; the ordinary call needs only a part.
            pass
        # The ordinary call's message names the pose that is not finite.
        return self._host()

    def explain(self) -> str:
        return f"NumPy arrays are copied with each call: {self._packed.explain()}"

    def check(self) -> None:
        """See BoundCall.check."""


def _shape_of(name: str, value: Any, shape: tuple[int | str, ...]) -> tuple[int, ...]:
    """Return the shape of an array in host memory; each call reads its present numbers."""
    actual = np.shape(cast(Any, arrays.to_host(masks.filled(value), name)))
    if len(actual) != len(shape) or any(isinstance(n, int) and n != m for n, m in zip(shape, actual, strict=True)):
        raise ValueError(f"{name}: shape must be {checks.shape_text(shape)}, got {checks.shape_text(actual)}")
    return actual
