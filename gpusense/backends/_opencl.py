"""OpenCL backend: any vendor's driver through pyopencl."""

from __future__ import annotations

import threading
import warnings
import weakref
from typing import Any

import numpy as np
import pyopencl as cl

from gpusense.backends import _pocl
from gpusense.backends.base import BackendInfo, Launcher, ProcessBound
from gpusense.backends.cache import ProgramCache
from gpusense.signatures import KERNELS, Kernel, lanes_of
from gpusense.sources import assemble, relevant, uses_double, with_places

# Devices that check or emulate: correct, but no one wants to wait for them unasked.
SIMULATORS = ("oclgrind", "simulator", "emulat", "fpga")
_LOST = ("DEVICE_NOT_AVAILABLE", "INVALID_COMMAND_QUEUE", "INVALID_CONTEXT", "INVALID_DEVICE")
_OUT_OF_MEMORY = ("OUT_OF_RESOURCES", "MEM_OBJECT_ALLOCATION_FAILURE", "OUT_OF_HOST_MEMORY", "INVALID_BUFFER_SIZE")
# One driver's own clearing hangs beyond 2 GiB.
_CLEAR = "kernel void clear(global uint *words, const ulong first) { words[first + get_global_id(0)] = 0; }"
_CLEARED_WORDS = 1 << 28
_ROUNDED_DIVISION = cl.device_fp_config.CORRECTLY_ROUNDED_DIVIDE_SQRT


def is_simulator(name: str) -> bool:
    """Whether a device of that name only imitates hardware."""
    return any(word in name.lower() for word in SIMULATORS)


def list_devices() -> list[tuple[BackendInfo, cl.Device]]:
    """All OpenCL devices of this machine, simulators included, in the order of the platforms."""
    found = []
    try:
        platforms = cl.get_platforms()
    except cl.LogicError:
        return []
    for p, platform in enumerate(platforms):
        try:
            devices = platform.get_devices()
        except cl.Error:
            continue
        found += [(_describe(f"opencl:{p}:{d}", device), device) for d, device in enumerate(devices)]
    return found


def _describe(selection: str, device: cl.Device) -> BackendInfo:
    return BackendInfo(
        selection=selection,
        backend="opencl",
        name=device.name.strip(),
        kind="gpu" if device.type & cl.device_type.GPU else "cpu",
        driver=f"{device.platform.name.strip()} {device.driver_version.strip()}",
        memory=int(device.global_mem_size),
        max_buffer=int(device.max_mem_alloc_size),
        float64=bool(device.double_fp_config),
        lanes=_lanes(device),
    )


def _lanes(device: cl.Device) -> int:
    """PoCL compiles loops in kernels as they are written; other drivers make vectors of neighbouring work-items."""
    if not _pocl.is_pocl(device) or not device.type & cl.device_type.CPU:
        return 1
    return 16 if device.native_vector_width_float >= 16 else 8


def _program_cache(info: BackendInfo, device: cl.Device) -> ProgramCache | None:
    """Where programs are kept; None for PoCL, which keeps them itself.

    Asked for a binary, PoCL would compile all kernels of the program, wanted or not, for work-groups of any size. That
    takes three times as long as all it does unasked.
    """
    return None if _pocl.is_pocl(device) else ProgramCache(info)


class _Buffer(cl.Buffer):
    """A buffer that can be referred to without being kept alive."""


class OpenCLBackend(ProcessBound):
    """One OpenCL device: a context, an in-order queue and the programs compiled for it."""

    def __init__(self, info: BackendInfo, device: cl.Device) -> None:
        super().__init__()
        self.info = info
        self._device = device
        _pocl.mend(device)
        self._context = cl.Context([device])
        self._queue = cl.CommandQueue(self._context)
        self._launchers: dict[tuple[str, frozenset[str]], _Launch] = {}
        self._programs: dict[tuple[str, frozenset[str]], cl.Program] = {}
        self._cache = _program_cache(info, device)
        # Ranges are the same bits everywhere only if division is rounded correctly; GPUs must be asked for it.
        rounded = bool(device.single_fp_config & _ROUNDED_DIVISION)
        self.options = ["-cl-fp32-correctly-rounded-divide-sqrt"] if rounded else []

    def upload(self, array: np.ndarray, out: cl.Buffer | None = None, *, wait: bool = True) -> cl.Buffer:
        """See Backend.upload."""
        self.check_process()
        buffer = self.empty(array.size, array.dtype) if out is None else out
        if array.size:
            with _driver_errors():
                cl.enqueue_copy(self._queue, buffer, np.ascontiguousarray(array), is_blocking=wait)
        return buffer

    def empty(self, count: int, dtype: np.dtype, *, zero: bool = False) -> cl.Buffer:
        """See Backend.empty."""
        size = -(-max(count, 1) * np.dtype(dtype).itemsize // 4) * 4
        if size > self.info.max_buffer:
            raise MemoryError(
                f"{self.info.name} cannot hold a buffer of {size} bytes: its largest is {self.info.max_buffer} bytes"
            )
        with _driver_errors():
            buffer = _Buffer(self._context, cl.mem_flags.READ_WRITE, size)
            if zero:
                self._clear(buffer, size)
        return buffer

    def _clear(self, buffer: cl.Buffer, size: int) -> None:
        if size <= 4 * _CLEARED_WORDS:
            cl.enqueue_fill_buffer(self._queue, buffer, np.zeros(1, np.uint8), 0, size)
            return
        kernel, words = cl.Kernel(self._built(cl.Program(self._context, _CLEAR)), "clear"), size // 4
        for first in range(0, words, _CLEARED_WORDS):
            kernel.set_args(buffer, np.uint64(first))
            cl.enqueue_nd_range_kernel(self._queue, kernel, (min(_CLEARED_WORDS, words - first),), None)

    def download(self, buffer: cl.Buffer, out: np.ndarray, *, wait: bool = True) -> np.ndarray:
        """See Backend.download."""
        if out.size:
            with _driver_errors():
                cl.enqueue_copy(self._queue, out, buffer, is_blocking=wait)
        return out

    def part(self, buffer: cl.Buffer, first: int, count: int) -> cl.Buffer:
        """See Backend.part."""
        raise TypeError("buffer: parts of OpenCL buffers are not used")

    def compile(self, kernel: str, flags: frozenset[str]) -> Launcher:
        """See Backend.compile."""
        self.check_process()
        launcher = self._launchers.get((kernel, flags))
        if launcher is None:
            launcher = self._launchers[kernel, flags] = self._launcher(kernel, flags)
        return launcher

    def synchronize(self) -> None:
        """See Backend.synchronize."""
        with _driver_errors():
            self._queue.finish()

    def _launcher(self, kernel: str, flags: frozenset[str]) -> _Launch:
        row = KERNELS[kernel]
        flags = relevant(row.file, flags)
        program = self._programs.get((row.file, flags))
        if program is None:
            program = self._programs[row.file, flags] = self._build(row.file, flags)
        return _Launch(self._queue, cl.Kernel(program, kernel), row, flags)

    def _build(self, file: str, flags: frozenset[str]) -> cl.Program:
        if "FLOAT64" in flags and not self.info.float64:
            raise ValueError(f"precision: must be 'float32' on {self.info.name}, which has no float64, got 'float64'")
        if not self.info.float64 and uses_double(file, flags):
            raise ValueError(f"{file}.cl: computes in float64, which {self.info.name} does not have")
        source = assemble(file, flags)
        if (program := self._kept(source)) is not None:
            return program
        try:
            program = self._built(cl.Program(self._context, source))
        except cl.RuntimeError as error:
            log = with_places(str(error), source)
            raise RuntimeError(f"{file}.cl did not compile on {self.info.name}: {log}") from error
        if self._cache is not None:
            binaries: Any = program.get_info(cl.program_info.BINARIES)
            self._cache.store(source, self.options, binaries[0])
        return program

    def _kept(self, source: str) -> cl.Program | None:
        """The program as an earlier run compiled it, where there is one that the driver still takes."""
        binary = None if self._cache is None else self._cache.load(source, self.options)
        if self._cache is None or binary is None:
            return None
        try:
            return self._built(cl.Program(self._context, [self._device], [binary]))
        except cl.Error:
            self._cache.discard(source, self.options)
            return None

    def _built(self, program: cl.Program) -> cl.Program:
        with warnings.catch_warnings():
            # Some drivers write a log for every program; pyopencl shows it where PYOPENCL_COMPILER_OUTPUT is set.
            warnings.simplefilter("ignore", cl.CompilerWarning)
            return program.build(self.options, [self._device])


def _nothing() -> None:
    """What an argument is bound to at first."""


class _Launch:
    """Binds arguments by the signature table and enqueues."""

    def __init__(self, queue: cl.CommandQueue, kernel: cl.Kernel, row: Kernel, flags: frozenset[str]) -> None:
        self._queue, self._kernel = queue, kernel
        self._lanes, self._group = (1, row.group)
        if "WIDE" in flags:
            self._lanes, self._group = (lanes_of(flags) if row.wide else 1), row.wide_group
        float64 = "FLOAT64" in flags
        self._lock = threading.Lock()
        real = np.dtype(np.float64 if float64 else np.float32)
        self._scalars = [a.dtype(real).type if a.shape is None else None for a in row.arguments]
        # What the kernel has; most calls change a few of many arguments. Of buffers a weak reference, so that one that
        # is given up is free, and another in its place is told from it.
        self._bound: list[Any] = [_nothing] * len(self._scalars)

    def __call__(self, size: tuple[int, ...], *arguments: Any) -> None:
        group = (self._group, *(1 for _ in size[1:]))
        rounded = (-(-size[0] // (self._lanes * group[0])) * group[0], *size[1:])
        # Arguments belong to the kernel object, so two threads must not interleave here.
        with self._lock, _driver_errors():
            for i, (scalar, value, last) in enumerate(zip(self._scalars, arguments, self._bound, strict=True)):
                if scalar is None:
                    if last() is not value:
                        self._kernel.set_arg(i, value)
                        self._bound[i] = weakref.ref(value)
                elif last is _nothing or last != value:
                    self._kernel.set_arg(i, scalar(value))
                    self._bound[i] = value
            cl.enqueue_nd_range_kernel(self._queue, self._kernel, rounded, group)


class _driver_errors:
    """Turns the driver's codes into MemoryError, or a RuntimeError that says the device is gone."""

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if not isinstance(error, cl.Error):
            return
        if any(code in str(error) for code in _OUT_OF_MEMORY):
            raise MemoryError(f"the OpenCL device is out of memory: {error}") from error
        if any(code in str(error) for code in _LOST):
            raise RuntimeError(f"the OpenCL device is no longer available, make the model anew: {error}") from error
