"""``bind`` of a model: the choice among bound calls, and bound calls that wait."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import Any, cast

import numpy as np

from gpusense._util import checks
from gpusense.backends import arrays
from gpusense.backends.arrays import FLOATS, Result
from gpusense.models.scan.bound import BoundCall, RecordedCall, RecordedCast
from gpusense.models.scan.map_caster import MapCaster
from gpusense.models.scan.packed_call import LARGEST, MOST_CELLS, PackedCall, fits, host_task, is_short
from gpusense.models.scan.pipeline import ScanPipeline
from gpusense.tables.world_index import WorldIndex
from gpusense.tables.world_map import index_of
from gpusense.tables.worlds import Worlds


class WaitingCall(BoundCall):
    """A call that has ended when it returns: ``packed``, of few particles, or else the ordinary call."""

    waits = True

    def __init__(self, score: Callable[..., Any], bound: tuple[Any, ...], out: Any, reason: str) -> None:
        self._score, self._bound, self.out, self._reason = score, bound, out, reason
        self.packed: PackedCall | None = None
        self._lock = threading.Lock()

    def __call__(self, stream: Any = None) -> Any:
        if stream is not None:
            raise TypeError(f"stream: must be None for a call that waits, got {checks.show(stream)}")
        if self.packed is not None:
            try:
                with self._lock:
                    if self.packed.score(*cast("tuple[Any, Any]", self._bound), self.out) is not None:
                        return self.out
            except MemoryError:
                # This call would need the whole table of a changed map; the ordinary call needs only a part.
                pass
        # The ordinary call's message names the pose that is not finite.
        return self._score(*self._bound, out=self.out)

    def explain(self) -> str:
        if self.packed is None:
            return f"the ordinary call: {self._reason}"
        return f"NumPy arrays are copied with each call: {self.packed.explain()}"

    def check(self) -> None:
        """See BoundCall.check."""


def bind(
    pipeline: ScanPipeline, lock: threading.Lock, score: Callable[..., Any], poses: Any, ranges: Any, out: Any
) -> BoundCall:
    """Bind arrays; ``score``: ``log_likelihood`` of the model. See ``ScanModel.bind``."""
    on_device = _check_bound(poses=poses, ranges=ranges)
    backend, beams, obstacle = pipeline.backend, pipeline.scanner.count, host_task(pipeline)
    if all(on_device) and not obstacle and backend.info.kind == "gpu":
        return RecordedCall(pipeline, lock, poses, ranges, out)
    if on_device[0]:
        count = arrays.adopt_poses(poses, backend, "poses")[1]
    else:
        count = _shape_of("poses", poses, ("N", 3))[0]
    if on_device[1]:
        arrays.adopt_readings(ranges, backend, (beams,), in_place=False)
    else:
        _shape_of("ranges", ranges, (beams,))
    result = Result(poses, out, (count,), pipeline.real, backend, on_device=on_device[0]).user_array()
    if all(on_device):
        obstacle = obstacle or "processors score scans that the host prepares"
    bound = poses, ranges
    call = WaitingCall(score, bound, result, obstacle or _long_reason(pipeline, *bound, result))
    if not call._reason:
        inputs = tuple(None if type(array) is np.ndarray else array for array in bound)
        limits = None if inputs[1] is not None else ranges.dtype
        target = None if type(result) is np.ndarray else result
        try:
            call.packed = PackedCall(pipeline, lock, count, cast(Any, inputs), target, limits)
        except MemoryError:
            # The ordinary call needs only a part of the map's table.
            call._reason = "the table of the whole map does not fit the device"
    return call


def bind_worlds(
    pipeline: ScanPipeline, lock: threading.Lock, score: Callable[..., Any], worlds: Worlds, poses: Any, ranges: Any,
    out: Any, **indices: Any,
) -> BoundCall:  # fmt: skip
    """Bind arrays of robots in many worlds; ``indices`` are ``world`` and ``ignore`` of ``ScanModel.bind``."""
    backend, rules = pipeline.backend, pipeline.rules
    # Scans whose beams are chosen by their readings, or share rays, are prepared by the host.
    placed = rules.choice.every and rules.separate and pipeline.context.possible
    if (
        all(_check_bound(poses=poses, ranges=ranges))
        and backend.info.kind == "gpu"
        and (placed or len(ranges.shape) == 1)
    ):
        inside = WorldIndex(worlds, indices["world"], indices["ignore"], int(poses.shape[0]), backend)
        return RecordedCall(pipeline, lock, poses, ranges, out, inside=inside.resident(backend))

    def scored(poses: Any, ranges: Any, out: Any) -> Any:
        return score(poses, ranges, out=out, **indices)

    # The first call checks the arguments, and makes the result.
    result = scored(poses, ranges, out)
    return WaitingCall(
        scored, (poses, ranges), result, "poses or ranges are in host memory, or the host prepares the scans"
    )


def bind_cast(
    caster: MapCaster, cast_rays: Callable[..., Any], poses: Any, vectors: np.ndarray, out: Any, **indices: Any
) -> BoundCall:
    """Bind poses to ``cast_rays``, the call of ``RayCaster.cast``; ``indices`` are its ``world`` and ``ignore``."""
    (on_device,) = _check_bound(poses=poses)
    if not (on_device and caster.backend.info.kind == "gpu"):
        result = cast_rays(poses, out=out, **indices)
        call = functools.partial(cast_rays, **indices)
        return WaitingCall(call, (poses,), result, "poses are in host memory, or the device is a processor")

    def index(count: int) -> WorldIndex | None:
        found = index_of(caster.grid, indices["world"], indices["ignore"], count, caster.backend)
        return None if found is None else found.resident(caster.backend)

    return RecordedCast(caster, poses, vectors, out, index)


def bind_terms(pipeline: ScanPipeline, lock: threading.Lock, poses: Any, ranges: Any, out: Any) -> RecordedCall | None:
    """Return the call that keeps the term of each reading; None where the host must prepare the readings."""
    plain = pipeline.specialize and pipeline.rules.separate and pipeline.context.possible
    if not plain or host_task(pipeline):
        return None
    return RecordedCall(pipeline, lock, poses, ranges, out, per_beam=True)


def _long_reason(pipeline: ScanPipeline, poses: Any, ranges: Any, out: Any) -> str:
    """Return why arrays in host memory are not copied with a recorded program; empty for arrays of a short call."""
    if not pipeline.backend.replays:
        return f"{pipeline.backend.info.selection} starts launches fast enough without a recording"
    here = [a for a in (poses, ranges, out) if not arrays.on_device(a)]
    if not all(type(a) is np.ndarray and a.dtype in FLOATS for a in here):
        return "only NumPy arrays of float32 or float64 are copied with a recorded program"
    if not fits(poses, ranges.shape[0]):
        return f"poses and ranges take more than {LARGEST >> 10} KiB"
    if pipeline.grid.cells.size > MOST_CELLS:
        return f"the map has more than {MOST_CELLS} cells"
    if not is_short(poses.shape[0], ranges.shape[0]):
        return f"{poses.shape[0]} poses times {ranges.shape[0]} readings are no short call"
    return ""


def _check_bound(**named: Any) -> list[bool]:
    """Refuse objects that are not arrays, or that cannot change; return which are on the device."""
    for name, array in named.items():
        if not (isinstance(array, np.ndarray) or hasattr(array, "__dlpack__") or arrays.on_device(array)):
            raise TypeError(f"{name}: must be an array, whose numbers every call reads anew, got {checks.show(array)}")
        if type(array).__module__.startswith("jax"):
            raise TypeError(f"{name}: must be an array whose numbers can change, got one of JAX, where none do")
    return [arrays.on_device(array) for array in named.values()]


def _shape_of(name: str, value: Any, shape: tuple[int | str, ...]) -> tuple[int, ...]:
    """Return the shape of an array in host memory; each call reads its present numbers."""
    actual = np.shape(cast(Any, arrays.to_host(checks.filled(value), name)))
    if len(actual) != len(shape) or any(isinstance(n, int) and n != m for n, m in zip(shape, actual, strict=True)):
        raise ValueError(f"{name}: shape must be {checks.shape_text(shape)}, got {checks.shape_text(actual)}")
    return actual
