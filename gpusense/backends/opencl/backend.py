"""OpenCL backend: any vendor's driver through pyopencl."""

from __future__ import annotations

import functools
import math
import os
import struct
import threading
import time
import weakref
from collections.abc import Callable, Hashable
from typing import Any

import numpy as np
import pyopencl as cl

from gpusense.backends import processor
from gpusense.backends.base import Adopted, Backend, BackendInfo, Buffer, ProcessBound
from gpusense.backends.opencl import memory, pocl
from gpusense.backends.opencl.memory import (
    SHARED,
    DeviceBuffer,
    SharedBuffer,
    driver_errors,
    group_multiple,
    raise_clearly,
    shares_memory,
    slots_of,
)  # fmt: skip
from gpusense.backends.opencl.programs import BoundLaunch, OpenCLRecording, Programs, new_kernel, without_caches
from gpusense.backends.processor import Staging
from gpusense.backends.recycled import ResultMemory
from gpusense.interface import launches, structs
from gpusense.interface.launches import Program
from gpusense.interface.signatures import KERNELS, Argument, Kernel, lanes_of, team_of
from gpusense.interface.sources import assemble, relevant, uses_double

# The fill command of one driver hangs beyond 2 GiB.
_CLEAR = "kernel void clear(global uint *words, const ulong first) { words[first + get_global_id(0)] = 0; }"
_CLEARED_WORDS = 1 << 28
# Largest copy from a GPU that is started after a wait for launches [bytes].
_FEW_BYTES = 1 << 10
# Copies to a GPU of these sizes [bytes] take NVIDIA's driver nearly twice as long if they do not block.
_SLOW = (64 << 10, 256 << 10)


class OpenCLBackend(ProcessBound, Backend):
    """One OpenCL device: a context, an in-order queue and the programs compiled for it.

    A copy that is a command takes a driver for processors some 25 us. Where host and device share memory, NumPy copies
    instead, after a wait for all commands.
    """

    def __init__(self, info: BackendInfo, device: cl.Device, queue: cl.CommandQueue | None = None) -> None:
        super().__init__()
        self.info = info
        self._device = device
        pocl.fit_target(device)
        # Intel's driver does not keep the context of a queue alive.
        self._context = cl.Context([device]) if queue is None else queue.context
        self._queue = cl.CommandQueue(self._context) if queue is None else queue
        self._shared = shares_memory(device)
        self.results = ResultMemory() if info.kind == "gpu" else None
        # Staged copies, only for the driver with which they were measured.
        staged = info.kind == "gpu" and not self._shared and "NVIDIA" in device.vendor
        self._staging = Staging(functools.partial(slots_of, self._queue)) if staged else None
        # Numbers of commands that were queued, and that are known to have ended. The lock is reentrant, since garbage
        # may be collected while it is held.
        self._count = threading.RLock()
        self._queued = self._ended = 0
        self.alignment = memory.alignment_of(device)
        self._launchers: dict[tuple[str, frozenset[str]], Launch] = {}
        # Launches of recordings that are alive; each keeps its arguments alive, so their identities stay unique.
        self._launches = weakref.WeakValueDictionary[tuple[object, ...], BoundLaunch]()
        self.programs = Programs(info, device, self._context)
        self._pocl = self.programs.pocl
        # The last launch, if its groups leave a processor to the calling thread.
        self._most_watched = processor.threads() - 1 if self._pocl is not None else 0
        self._last: cl.Event | None = None

    @property
    def queue(self) -> cl.CommandQueue:
        """The in-order queue of all commands; arrays of pyopencl that are made with it are used in place."""
        return self._queue

    def upload(self, array: np.ndarray, out: Buffer | None = None, *, wait: bool = True) -> Buffer:
        if os.getpid() != self._process:
            self.check_process()
        buffer = self.empty(array.size, array.dtype) if out is None else out
        if array.size:
            array = np.ascontiguousarray(array)
            if isinstance(buffer, SHARED):
                if self._ended != self._queued:
                    self.synchronize()
                buffer.view[: array.nbytes] = array.data.cast("B")
                return buffer
            if self._staging is not None and self._staging.upload(array, buffer):
                return buffer
            with driver_errors():
                blocking = wait or _SLOW[0] < array.nbytes <= _SLOW[1]
                cl.enqueue_copy(self._queue, buffer, array, is_blocking=blocking)
        return buffer

    def refill(self, array: np.ndarray, buffer: Buffer) -> None:
        """See Backend.refill; shared memory needs no wait."""
        if isinstance(buffer, SHARED):
            buffer.view[: array.nbytes] = array.data.cast("B")
        else:
            self.upload(array, buffer, wait=False)

    def empty(self, count: int, dtype: np.dtype, *, zero: bool = False) -> Buffer:
        size = -(-max(count, 1) * np.dtype(dtype).itemsize // 4) * 4
        self._check_size(size)
        with driver_errors():
            if self._shared:
                shared = SharedBuffer(self._context, size, self._settle)
                if zero:
                    shared.bytes[:] = 0
                return shared
            buffer = DeviceBuffer(self._context, cl.mem_flags.READ_WRITE, size)
            if zero:
                self._clear(buffer, size)
        return buffer

    def _check_size(self, size: int) -> None:
        """Refuse a buffer that is larger than the device's largest."""
        if size > self.info.max_buffer:
            raise MemoryError(
                f"{self.info.name} cannot hold a buffer of {size} bytes: its largest is {self.info.max_buffer} bytes"
            )

    def _clear(self, buffer: cl.Buffer, size: int) -> None:
        """Enqueue a command that sets ``size`` bytes of a buffer to 0."""
        if size <= 4 * _CLEARED_WORDS:
            cl.enqueue_fill_buffer(self._queue, buffer, np.zeros(1, np.uint8), 0, size)
            return
        kernel, words = new_kernel(self.programs.built(cl.Program(self._context, _CLEAR)), "clear"), size // 4
        for first in range(0, words, _CLEARED_WORDS):
            kernel.set_args(buffer, np.uint64(first))
            cl.enqueue_nd_range_kernel(self._queue, kernel, (min(_CLEARED_WORDS, words - first),), None)

    def download(self, buffer: Buffer, out: np.ndarray, *, wait: bool = True) -> np.ndarray:
        if out.size:
            if isinstance(buffer, SHARED):
                if self._ended != self._queued:
                    self.synchronize()
                out.data.cast("B")[:] = buffer.view[: out.nbytes]
                return out
            if self._staging is not None and self._staging.download(buffer, out):
                return out
            with driver_errors():
                if wait and out.nbytes <= _FEW_BYTES:
                    # NVIDIA's driver waits longer for a copy than for launches and an idle device's copy.
                    self._queue.finish()
                cl.enqueue_copy(self._queue, out, buffer, is_blocking=wait)
        return out

    def part(self, buffer: Buffer, first: int, count: int, dtype: np.dtype) -> Buffer:
        size = np.dtype(dtype).itemsize
        return memory.part_of(buffer, first * size, count * size, self.alignment)

    def reads(self, array: object) -> bool:
        return memory.is_array(array)

    def adopt(self, array: Any, name: str, *, in_place: bool = False) -> Adopted:
        return memory.adopted(array, self._queue, self.info.selection, name, in_place=in_place)

    def empty_external(self, count: int, dtype: np.dtype) -> Buffer:
        """See Backend.empty_external; arrays of shared memory could not outlive the backend's launches."""
        size = max(count, 1) * np.dtype(dtype).itemsize
        self._check_size(size)
        with driver_errors():
            return DeviceBuffer(self._context, cl.mem_flags.READ_WRITE, size)

    def ahead(self, array: object) -> Hashable:
        return (type(array),)

    def copy(self, source: Buffer, target: Buffer, size: int, *, begin: int = 0, to: int = 0) -> None:
        if not size:
            return
        with driver_errors():
            if isinstance(target, SHARED):
                self._settle()
                cl.enqueue_copy(self._queue, target.bytes[to : to + size], source, src_offset=begin)
            else:
                cl.enqueue_copy(self._queue, target, source, byte_count=size, src_offset=begin, dst_offset=to)

    def wrap_external(self, buffer: Buffer, shape: tuple[int, ...], dtype: np.dtype) -> object:
        return memory.wrapped(buffer, self._queue, shape, dtype)

    @property
    def replays(self) -> bool:
        return self.info.kind == "gpu"

    def record(self, program: Program) -> OpenCLRecording:
        return OpenCLRecording(self._queue, [self._bound(one) for one in program], self._counted)

    def _bound(self, one: launches.Launch) -> BoundLaunch:
        """Return a launch with its arguments set; recordings share equal ones, since a driver takes up to 1 ms each."""
        arguments = [value if isinstance(value, (int, float, tuple)) else id(value) for value in one.arguments]
        key = one.kernel, one.flags, one.size, *arguments
        bound = self._launches.get(key)
        if bound is None:
            bound = self._launches[key] = self.compile(one.kernel, one.flags).bind(one.size, one.arguments)
        return bound

    def compile(self, kernel: str, flags: frozenset[str]) -> Launch:
        if os.getpid() != self._process:
            self.check_process()
        launcher = self._launchers.get((kernel, flags))
        if launcher is None:
            launcher = self._launchers[kernel, flags] = self._launcher(kernel, flags)
        return launcher

    def largest_group(self, kernel: str, flags: frozenset[str]) -> int:
        return self.compile(kernel, flags).limit

    def source(self, kernel: str, flags: frozenset[str]) -> str:
        file = KERNELS[kernel].file
        return assemble(file, relevant(file, flags))

    def synchronize(self) -> None:
        with self._count:
            queued = self._queued
        try:
            if (last := self._last) is not None:
                watch(last)
                self._last = None
            self._queue.finish()
        except cl.Error as error:
            raise_clearly(error)
        with self._count:
            self._ended = max(self._ended, queued)
        if self._pocl is not None and self._pocl.changed:
            self._pocl.save()

    def _settle(self) -> None:
        """Wait for all commands that this thread may have queued."""
        if self._ended != self._queued:
            self.synchronize()

    def enqueue(self, kernel: cl.Kernel, size: tuple[int, ...], group: tuple[int, ...]) -> None:
        """Enqueue a launch of a kernel whose arguments are set."""
        # Count it before the launch, so that an interrupt leaves none uncounted, and after it for threads that wait in
        # between.
        with self._count:
            self._queued += 1
        event = cl.enqueue_nd_range_kernel(self._queue, kernel, size, group)
        self._last = event if math.prod(size) <= self._most_watched * math.prod(group) else None
        with self._count:
            self._queued += 1

    def _counted(self, launches: int) -> None:
        with self._count:
            self._queued += launches

    def _launcher(self, kernel: str, flags: frozenset[str]) -> Launch:
        """Return a kernel; its program is built on first use."""
        file = KERNELS[kernel].file
        flags = relevant(file, flags)
        if "FLOAT64" in flags and not self.info.float64:
            raise ValueError(f"precision: must be 'float32' on {self.info.name}, which has no float64, got 'float64'")
        if not self.info.float64 and uses_double(file, flags):
            raise ValueError(f"{file}.cl: computes in float64, which {self.info.name} does not have")
        compiled, first = self.programs.kernel(kernel, flags)
        limit = compiled.get_work_group_info(cl.kernel_work_group_info.WORK_GROUP_SIZE, self._device)
        row = KERNELS[kernel].with_flags(flags)
        return Launch(self, compiled, row, flags, limit, first, group_multiple(compiled, self._device))


# ---- launches: arguments are bound by the signature table


# Longest time for which the end of a launch is watched [s].
_WATCHED = 1e-4


def watch(event: cl.Event) -> None:
    """Return once a launch has ended, or after a short while, without sleeping.

    PoCL's worker ends a short launch earlier than a thread falls asleep and wakes up, which takes 30 to 40 us.
    """
    end = time.perf_counter() + _WATCHED
    while event.command_execution_status > cl.command_execution_status.COMPLETE and time.perf_counter() < end:
        pass


class Launch:
    """A kernel that binds arguments by the signature table and enqueues its launch."""

    def __init__(
        self,
        backend: OpenCLBackend,
        kernel: cl.Kernel,
        row: Kernel,
        flags: frozenset[str],
        limit: int,
        first: Callable[[], None] | None = None,
        multiple: int = 1,
    ) -> None:
        self._backend, self._kernel = backend, kernel
        # Most work-items of a group of the kernel on the device.
        self.limit = limit
        # Function that is called once, before the kernel's first launch.
        self._first = first
        self._lanes, self._group = (1, row.group)
        if "IN_LANES" in flags:
            self._lanes, self._group = (lanes_of(flags) if row.in_lanes else 1), row.lanes_group
        elif "IN_TEAMS" in flags:
            self._group = team_of(row, flags)
        if "IN_TEAMS" not in flags:
            self._group = min(-(-self._group // multiple) * multiple, limit)
        self._lock = threading.Lock()
        real = np.dtype(np.float64 if "FLOAT64" in flags else np.float32)
        # With its types set, pyopencl sets all arguments in 1 us; otherwise a single number takes 6 us.
        self._types = [_set_as(argument, real) for argument in row.arguments]
        # Places of structs, and functions that pack them into the bytes that the device reads.
        self._packers = [
            (place, struct.Struct(structs.layout(argument.type, real)).pack)
            for place, argument in enumerate(row.arguments)
            if argument.is_struct
        ]
        self._last_structs: list[tuple[Any, bytes]] = [(None, b"")] * len(self._packers)
        self._last_size: tuple[Any, Any] = (None, None)
        with without_caches():
            kernel.set_arg_types(self._types)

    def __call__(self, size: tuple[int, ...], *arguments: Any) -> None:
        """See Launcher.__call__."""
        if self._first is not None:
            self._before_first()
        # Arguments belong to the kernel object, so two threads must not interleave.
        with self._lock:
            packed = list(arguments)
            for number, (place, pack) in enumerate(self._packers):
                # Calls mostly repeat the last struct.
                if packed[place] is not self._last_structs[number][0]:
                    self._last_structs[number] = packed[place], pack(*packed[place])
                packed[place] = self._last_structs[number][1]
            if size != self._last_size[0]:
                self._last_size = size, self._sizes(size)
            try:
                self._kernel.set_args(*packed)
                self._backend.enqueue(self._kernel, *self._last_size[1])
            except cl.Error as error:
                raise_clearly(error)

    def bind(self, size: tuple[int, ...], arguments: tuple[Any, ...]) -> BoundLaunch:
        """Set the arguments of a new kernel object, and start nothing."""
        if self._first is not None:
            self._before_first()
        kernel = new_kernel(self._kernel.program, self._kernel.function_name)
        with without_caches():
            kernel.set_arg_types(self._types)
        packed = list(arguments)
        for place, pack in self._packers:
            packed[place] = pack(*packed[place])
        kernel.set_args(*packed)
        return BoundLaunch(kernel, *self._sizes(size), arguments)

    def _before_first(self) -> None:
        """Call the function for the first launch."""
        if self._first is not None:
            self._first()
            self._first = None

    def _sizes(self, size: tuple[int, ...]) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return the size in whole groups, and the group."""
        group = (self._group, *(1 for _ in size[1:]))
        return (-(-size[0] // (self._lanes * group[0])) * group[0], *size[1:]), group


def _set_as(argument: Argument, real: np.dtype) -> Any:
    """Return the type with which pyopencl sets an argument; None for buffers."""
    if argument.is_struct:
        return np.dtype(("V", struct.calcsize(structs.layout(argument.type, real))))
    return argument.dtype(real).type if argument.shape is None else None
