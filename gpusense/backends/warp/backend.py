"""Warp backend: NVIDIA GPUs through CUDA, and the processor.

Warp's last thread index runs fastest, a signature row's first axis does: launches pass their size reversed, and the
kernels unpack ``wp.tid()`` in that order.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Hashable
from typing import Any

import numpy as np
import warp as wp

from gpusense._util.memory import prefer_large_pages
from gpusense.backends.base import Adopted, Backend, BackendInfo, Exchange, ProcessBound, Recording
from gpusense.backends.processor import Staging
from gpusense.backends.recycled import ResultMemory
from gpusense.backends.warp.arrays import Results, adopted, has_protocol, slots_of
from gpusense.backends.warp.graphs import GraphCache, GraphExchange, WarpRecording
from gpusense.backends.warp.launch import SCALARS, Launch, host_view
from gpusense.backends.warp.pieces import SharedLaunch, shared
from gpusense.backends.warp.queue import CallQueue
from gpusense.backends.warp.settings import LOCK, initialize, load, settings
from gpusense.interface.kernel_files import warp_files, warp_source
from gpusense.interface.launches import Program
from gpusense.interface.signatures import KERNELS, Kernel, team_of
from gpusense.interface.sources import relevant

_MOST_NUMBERS = (1 << 31) - 1
# Largest copy that a thread reads through its cached memory of each type [bytes].
_FEW_BYTES = 1 << 10


class WarpBackend(ProcessBound, Backend):
    """One Warp device: flat arrays of numbers as buffers, launches on the device's current stream."""

    alignment = 1

    def __init__(self, info: BackendInfo, device: str) -> None:
        super().__init__()
        initialize()
        self.info = info
        self._device = wp.get_device(device)
        self._graphs = GraphCache(self._device)
        self.results = ResultMemory() if info.kind == "gpu" else None
        self._results_there = Results(self._device, self.empty)
        # Large copies; None on the processor, which uses the host's memory.
        self._staging = Staging(functools.partial(slots_of, self._device)) if self._device.is_cuda else None
        # The queue of each thread that has a batch, and the queues that no call uses.
        self._thread = threading.local()
        self._queues: list[CallQueue] = []
        # By the flags that change code, and by all flags of a launch.
        self._launchers: dict[tuple[str, frozenset[str]], Launch | SharedLaunch] = {}
        self._asked: dict[tuple[str, frozenset[str]], Launch | SharedLaunch] = {}

    def upload(self, array: np.ndarray, out: wp.array | None = None, *, wait: bool = True) -> wp.array:
        self.check_process()
        array = np.ascontiguousarray(array)
        buffer = self.empty(array.size, array.dtype) if out is None else out
        if array.size:
            queue = self.batch()
            if queue is not None:
                if not wait and queue.upload(array, buffer):
                    return buffer
                self._flush(queue)
            if self._staging is not None and self._staging.upload(array, buffer):
                # Page-locked memory holds the numbers until the device has read them.
                return buffer
            wp.copy(buffer, host_view(array), count=array.size)
            if wait:
                # The copy returns while the device still reads page-locked host memory.
                self._wait()
        return buffer

    def empty(self, count: int, dtype: np.dtype, *, zero: bool = False) -> wp.array:
        count, dtype = max(count, 1), np.dtype(dtype)
        size = count * dtype.itemsize
        if size > self.info.max_buffer or count > _MOST_NUMBERS:
            raise MemoryError(
                f"{self.info.name} cannot hold a buffer of {size} bytes: its largest is {self.info.max_buffer} bytes "
                f"and {_MOST_NUMBERS} numbers"
            )
        try:
            made = wp.empty(count, dtype=SCALARS[dtype], device=self._device)
            if self._device.is_cpu:
                prefer_large_pages(made.ptr, size)
            if zero:
                made.zero_()
            return made
        except RuntimeError as error:
            if "Failed to allocate" in str(error):
                raise MemoryError(f"{self.info.name} is out of memory: {error}") from error
            raise

    def download(self, buffer: wp.array, out: np.ndarray, *, wait: bool = True) -> np.ndarray:
        if out.size:
            queue = self.batch()
            if queue is not None:
                if not wait and queue.download(buffer, out):
                    return out
                self._flush(queue)
            if self.info.kind == "gpu":
                room = self._room(out.dtype)
                if out.nbytes <= _FEW_BYTES:
                    return self._read(buffer, out, *room)
            if self._staging is not None and self._staging.download(buffer, out):
                return out
            wp.copy(host_view(out), buffer, count=out.size)
            if wait:
                self._wait()
        return out

    def _room(self, dtype: np.dtype) -> tuple[wp.array, np.ndarray]:
        """Return the page-locked memory through which this thread reads few numbers of a type, as two views."""
        rooms = self._thread.__dict__.setdefault("rooms", {})
        if dtype not in rooms:
            count = _FEW_BYTES // dtype.itemsize
            memory = wp.empty(count, dtype=SCALARS[dtype], device="cpu", pinned=self._device.is_cuda)
            rooms[dtype] = memory, memory.numpy()
        return rooms[dtype]

    def _read(self, buffer: wp.array, out: np.ndarray, memory: wp.array, numbers: np.ndarray) -> np.ndarray:
        """Copy few numbers through page-locked memory, which takes less than half of the time of other memory."""
        wp.copy(memory, buffer, count=out.size)
        self._wait()
        out.reshape(-1)[...] = numbers[: out.size]
        return out

    def part(self, buffer: wp.array, first: int, count: int, dtype: np.dtype) -> wp.array:
        kind = SCALARS[np.dtype(dtype)]
        if kind is not buffer.dtype:
            view = wp.array(
                ptr=buffer.ptr + first * np.dtype(dtype).itemsize, dtype=kind, shape=(count,), device=self._device
            )
            view._gpusense_owner = buffer
            return view
        return buffer if (first, count) == (0, buffer.size) else buffer[first : first + count]

    def reads(self, array: object) -> bool:
        return self.info.kind == "gpu" and has_protocol(array)

    def adopt(self, array: Any, name: str, *, in_place: bool = False) -> Adopted:
        """See Backend.adopt; every array on the device can be used in place."""
        return adopted(array, self._device, name)

    def ahead(self, array: object) -> Hashable:
        """See Backend.ahead; memory is bound to the current stream, and other libraries use streams unknown here."""
        return (wp.array, self._device.stream if self._device.is_cuda else None) if type(array) is wp.array else None

    def empty_like(self, array: Any, shape: tuple[int, ...], dtype: np.dtype) -> tuple[Any, wp.array] | None:
        return self._results_there.empty_like(array, shape, dtype)

    def empty_external(self, count: int, dtype: np.dtype) -> wp.array:
        return self.part(self.empty(count, dtype), 0, count, dtype)

    def copy(self, source: wp.array, target: wp.array, size: int, *, begin: int = 0, to: int = 0) -> None:
        if not size:
            # Warp takes a count of 0 as the whole array.
            return
        # The copy follows all deferred work.
        self.submit()
        from_size, to_size = (wp.types.type_size_in_bytes(array.dtype) for array in (source, target))
        wp.copy(target, source, dest_offset=to // to_size, src_offset=begin // from_size, count=size // from_size)

    def wrap_external(self, buffer: wp.array, shape: tuple[int, ...], dtype: np.dtype) -> wp.array:
        return buffer if buffer.shape == shape else buffer.reshape(shape)

    @property
    def replays(self) -> bool:
        return self.info.kind == "gpu" and self.info.graphs

    def compile(self, kernel: str, flags: frozenset[str]) -> Launch | SharedLaunch:
        self.check_process()
        launcher = self._asked.get((kernel, flags))
        if launcher is None:
            key = (kernel, relevant(KERNELS[kernel].file, flags))
            with LOCK:
                launcher = self._launchers.get(key)
                if launcher is None:
                    launcher = self._launchers[key] = self._build(KERNELS[kernel].with_flags(flags), *key)
            self._asked[kernel, flags] = launcher
        return launcher

    def largest_group(self, kernel: str, flags: frozenset[str]) -> int:
        """See Backend.largest_group; every CUDA device has registers for 256 work-items of any kernel."""
        return 256

    def source(self, kernel: str, flags: frozenset[str]) -> str:
        """See Backend.source; flags are constants of the file, which Warp resolves."""
        return warp_source(KERNELS[kernel].file)

    def synchronize(self) -> None:
        queue = self.batch()
        if queue is not None:
            self._flush(queue)
        self._wait()
        if queue is not None:
            queue.deliver()

    def exchange(self, inputs: wp.array, given: int, results: wp.array, taken: int, dtype: np.dtype) -> Exchange:
        if not self.info.graphs:
            return super().exchange(inputs, given, results, taken, dtype)
        return GraphExchange(self, self._device, self._graphs, (inputs, given), (results, taken))

    def begin_batch(self) -> None:
        if not self.info.graphs:
            return
        try:
            queue = self._queues.pop()
        except IndexError:
            queue = CallQueue(self._device, SCALARS)
        if not queue.settled:
            # An error ended this queue's last call; parts of it may still be running.
            self._wait()
        queue.begin()
        self._thread.queue = queue

    def submit(self) -> None:
        queue = self.batch()
        if queue is not None:
            self._flush(queue)

    def end_batch(self) -> None:
        queue = self.batch()
        if queue is not None:
            self._thread.queue = None
            try:
                self._flush(queue)
            finally:
                self._queues.append(queue)

    @property
    def in_batch(self) -> bool:
        return self.batch() is not None

    def record(self, program: Program) -> WarpRecording:
        """See Backend.record; launches know their buffers by address and keep none alive."""
        steps = [self.compile(one.kernel, one.flags).step(one.size, one.arguments) for one in program]
        return WarpRecording(self._device, self._graphs, [step for step in steps if step is not None])

    def replay(self, recording: Recording) -> None:
        queue = self.batch()
        if queue is None or not isinstance(recording, WarpRecording):
            recording()
        else:
            queue.steps.append(recording)

    def address(self, buffer: wp.array) -> int:
        return int(buffer.ptr or 0)

    def batch(self) -> CallQueue | None:
        """Return the queue of this thread's batch; None where it has none."""
        return getattr(self._thread, "queue", None)

    def _flush(self, queue: CallQueue) -> None:
        """Start the steps of a queue."""
        if queue.steps:
            steps, queue.steps = queue.steps, []
            self._graphs.start(steps)

    def _wait(self) -> None:
        """Wait for the current stream; on the processor, launches have ended when they return."""
        if self._device.is_cuda:
            wp.synchronize_stream(self._device)

    def _build(self, row: Kernel, kernel: str, flags: frozenset[str]) -> Launch | SharedLaunch:
        """Compile a kernel."""
        group = (team_of(row, flags) if "IN_TEAMS" in flags else row.group) if self._device.is_cuda else 1
        with settings():
            compiled = warp_files().kernel_of(kernel, flags)
            try:
                load(compiled.module, self._device, group)
            except Exception as error:
                raise RuntimeError(f"{row.file}.py did not compile on {self.info.name}: {error}") from error
        launch = Launch(self._device, compiled, row, group, self.batch)
        return launch if self._device.is_cuda else shared(launch, row)
