"""OpenCL backend: any vendor's driver through pyopencl."""

from __future__ import annotations

import contextlib
import functools
import math
import os
import re
import threading
import warnings
from typing import Any

import numpy as np
import pyopencl as cl

from gpusense.backends import processor
from gpusense.backends.base import Adopted, Backend, BackendInfo, Buffer, ProcessBound
from gpusense.backends.cache import discard_entry, load_entry, program_key, store_entry
from gpusense.backends.opencl import memory, pocl
from gpusense.backends.opencl.launch import Launch, OpenCLRecording, new_kernel, watch, without_caches
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
from gpusense.backends.processor import Staging
from gpusense.backends.recycled import ResultMemory
from gpusense.interface.launches import Program
from gpusense.interface.signatures import KERNELS
from gpusense.interface.sources import assemble, relevant, uses_double, with_places

# The fill command of one driver hangs beyond 2 GiB.
_CLEAR = "kernel void clear(global uint *words, const ulong first) { words[first + get_global_id(0)] = 0; }"
_CLEARED_WORDS = 1 << 28
# Copies to a GPU of these sizes [bytes] take NVIDIA's driver nearly twice as long if they do not block.
_SLOW = (64 << 10, 256 << 10)
_ROUNDED_DIVISION = cl.device_fp_config.CORRECTLY_ROUNDED_DIVIDE_SQRT


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
        # Programs with the keys of their entries in the cache.
        self._programs: dict[tuple[str, frozenset[str]], tuple[cl.Program, str]] = {}
        self._pocl = pocl.pocl_kernels() if pocl.is_pocl(device) else None
        self._of_bitcode = pocl.takes_bitcode(device)
        # The last launch, if its groups leave a processor to the calling thread.
        self._most_watched = processor.threads() - 1 if self._pocl is not None else 0
        self._last: cl.Event | None = None
        # Ranges are the same bits everywhere only if division is rounded correctly, an option on GPUs.
        rounded = bool(device.single_fp_config & _ROUNDED_DIVISION)
        self.options = ["-cl-fp32-correctly-rounded-divide-sqrt"] if rounded else []
        if self._pocl is not None:
            # PoCL would write the number of warnings to the terminal. Its hash of a kernel covers the options, not the
            # processor.
            self.options += ["-w", f"-DTARGET_{re.sub(r'[^a-z0-9]', '_', info.target)}"]

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
        kernel, words = new_kernel(self._built(cl.Program(self._context, _CLEAR)), "clear"), size // 4
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
        launches = [self.compile(one.kernel, one.flags).bind(one.size, one.arguments) for one in program]
        return OpenCLRecording(self._queue, launches, self._counted)

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
        row = KERNELS[kernel].with_flags(flags)
        if (file, flags) not in self._programs:
            self._programs[file, flags] = self._build(file, flags)
        program, key = self._programs[file, flags]
        first = None if self._pocl is None else functools.partial(self._pocl.mark, key)
        name = pocl.own_name(kernel, key) if self._of_bitcode else kernel
        compiled = new_kernel(program, name)
        limit = compiled.get_work_group_info(cl.kernel_work_group_info.WORK_GROUP_SIZE, self._device)
        return Launch(self, compiled, row, flags, limit, first, group_multiple(compiled, self._device))

    def _build(self, file: str, flags: frozenset[str]) -> tuple[cl.Program, str]:
        """Build the program of a kernel file; return it with its key in the cache."""
        if "FLOAT64" in flags and not self.info.float64:
            raise ValueError(f"precision: must be 'float32' on {self.info.name}, which has no float64, got 'float64'")
        if not self.info.float64 and uses_double(file, flags):
            raise ValueError(f"{file}.cl: computes in float64, which {self.info.name} does not have")
        source = assemble(file, flags)
        # Bitcode belongs to the version of LLVM, which the platform's version names.
        version = [self._device.platform.version] if self._of_bitcode else []
        key = program_key(self.info, source, [*self.options, *version])
        # PoCL's kernels are kept singly. For a binary, it would compile every kernel of the program for work-groups of
        # any size, which takes three times as long as the rest of the build.
        if self._pocl is None and (program := self._kept(key)) is not None:
            return program, key
        try:
            if self._pocl is not None and self._of_bitcode:
                return self._built_of_bitcode(self._pocl, file, source, key), key
            with contextlib.nullcontext() if self._pocl is None else self._pocl.building(key):
                program = self._built(cl.Program(self._context, source))
        except cl.RuntimeError as error:
            log = with_places(str(error), source)
            raise RuntimeError(f"{file}.cl did not compile on {self.info.name}: {log}") from error
        if self._pocl is None:
            binaries: Any = program.get_info(cl.program_info.BINARIES)
            devices: Any = program.get_info(cl.program_info.DEVICES)
            if binary := binaries[devices.index(self._device)]:
                store_entry(key, binary)
        return program, key

    def _built_of_bitcode(self, compiled: pocl.PoclKernels, file: str, source: str, key: str) -> cl.Program:
        """Return a program of a kernel file, with unique kernel names."""
        names = {name: pocl.own_name(name, key) for name, row in KERNELS.items() if row.file == file}
        options = [*self.options, *(f"-D{name}={other}" for name, other in names.items())]
        return compiled.built(
            key,
            list(names.values()),
            lambda: self._built(cl.Program(self._context, source), options),
            lambda bitcode: self._built(cl.Program(self._context, [self._device], [bitcode]), options),
        )

    def _kept(self, key: str) -> cl.Program | None:
        """Return the program that an earlier run compiled; None if the driver accepts no stored one."""
        binary = load_entry(key)
        if binary is None:
            return None
        try:
            return self._built(cl.Program(self._context, [self._device], [binary]))
        except cl.Error:
            discard_entry(key)
            return None

    def _built(self, program: cl.Program, options: list[str] | None = None) -> cl.Program:
        """Compile a program, or load its binary; the options are the backend's where none are passed."""
        with warnings.catch_warnings(), without_caches():
            # Some drivers write a log for every program; pyopencl shows it where PYOPENCL_COMPILER_OUTPUT is set.
            warnings.simplefilter("ignore", cl.CompilerWarning)
            return program.build(self.options if options is None else options, [self._device])
