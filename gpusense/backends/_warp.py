"""Warp backend: NVIDIA GPUs through CUDA, and the processor with one thread.

Warp's last thread index runs fastest, a signature row's first axis does: launches pass their size reversed, and the
kernels unpack ``wp.tid()`` in that order.
"""

from __future__ import annotations

import contextlib
import functools
import os
import tempfile
import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import warp as wp

from gpusense._kernel_files import warp_module
from gpusense.backends._numpy import _memory
from gpusense.backends.base import BackendInfo, Launcher, ProcessBound
from gpusense.backends.cache import cache_folder
from gpusense.signatures import KERNELS, Argument, Kernel
from gpusense.sources import relevant

_SCALARS = {
    np.dtype(np.uint8): wp.uint8,
    np.dtype(np.uint16): wp.uint16,
    np.dtype(np.int32): wp.int32,
    np.dtype(np.float32): wp.float32,
    np.dtype(np.float64): wp.float64,
}
_VECTORS = {
    (wp.int32, 2): wp.vec2i,
    (wp.float32, 2): wp.vec2f,
    (wp.float32, 4): wp.vec4f,
    (wp.float64, 2): wp.vec2d,
    (wp.float64, 4): wp.vec4d,
}
_MOST_NUMBERS = (1 << 31) - 1
_NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"
# Guards Warp's settings, which belong to the process.
_LOCK = threading.RLock()


def list_devices() -> list[tuple[BackendInfo, str]]:
    """Warp's devices of this machine and their names within Warp."""
    _initialize()
    return [(_describe(device), device.alias) for device in wp.get_devices()]


def _describe(device: wp.Device) -> BackendInfo:
    memory, driver = _memory(), f"Warp {wp.__version__}"
    if device.is_cuda:
        memory = int(device.total_memory)
        driver += " CUDA {}.{}".format(*wp.get_cuda_driver_version())
    return BackendInfo(
        selection=f"warp:{device.alias}",
        backend="warp",
        name=device.name,
        kind="gpu" if device.is_cuda else "cpu",
        driver=driver,
        memory=memory,
        max_buffer=memory,
        float64=True,
    )


class WarpBackend(ProcessBound):
    """One Warp device: flat arrays of numbers as buffers, launches on the device's current stream."""

    def __init__(self, info: BackendInfo, device: str) -> None:
        super().__init__()
        _initialize()
        self.info = info
        self._device = wp.get_device(device)
        # By the flags that change code, and by those that were asked for.
        self._launchers: dict[tuple[str, frozenset[str]], _Launch] = {}
        self._asked: dict[tuple[str, frozenset[str]], _Launch] = {}

    def upload(self, array: np.ndarray, out: wp.array | None = None, *, wait: bool = True) -> wp.array:
        """See Backend.upload."""
        self.check_process()
        array = np.ascontiguousarray(array)
        buffer = self.empty(array.size, array.dtype) if out is None else out
        if array.size:
            wp.copy(buffer, _host(array), count=array.size)
            if wait:
                # Page-locked host memory is still being read when the copy returns.
                self._wait()
        return buffer

    def empty(self, count: int, dtype: np.dtype, *, zero: bool = False) -> wp.array:
        """See Backend.empty."""
        count, dtype = max(count, 1), np.dtype(dtype)
        size = count * dtype.itemsize
        if size > self.info.max_buffer or count > _MOST_NUMBERS:
            raise MemoryError(
                f"{self.info.name} cannot hold a buffer of {size} bytes: its largest is {self.info.max_buffer} bytes "
                f"and {_MOST_NUMBERS} numbers"
            )
        make = wp.zeros if zero else wp.empty
        try:
            return make(count, dtype=_SCALARS[dtype], device=self._device)
        except RuntimeError as error:
            if "Failed to allocate" in str(error):
                raise MemoryError(f"{self.info.name} is out of memory: {error}") from error
            raise

    def download(self, buffer: wp.array, out: np.ndarray, *, wait: bool = True) -> np.ndarray:
        """See Backend.download."""
        if out.size:
            wp.copy(_host(out), buffer, count=out.size)
            if wait:
                self._wait()
        return out

    def part(self, buffer: wp.array, first: int, count: int) -> wp.array:
        """See Backend.part."""
        return buffer[first : first + count]

    def compile(self, kernel: str, flags: frozenset[str]) -> Launcher:
        """See Backend.compile."""
        self.check_process()
        launcher = self._asked.get((kernel, flags))
        if launcher is None:
            row = KERNELS[kernel]
            key = (kernel, relevant(row.file, flags))
            with _LOCK:
                launcher = self._launchers.get(key)
                if launcher is None:
                    launcher = self._launchers[key] = self._build(row, *key)
            self._asked[kernel, flags] = launcher
        return launcher

    def synchronize(self) -> None:
        """See Backend.synchronize."""
        wp.synchronize_device(self._device)

    def _wait(self) -> None:
        """Wait for the current stream; the processor has none and works at once."""
        if self._device.is_cuda:
            wp.synchronize_stream(self._device)

    def _build(self, row: Kernel, kernel: str, flags: frozenset[str]) -> _Launch:
        group = row.group if self._device.is_cuda else 1
        with _settings():
            made = warp_module(row.file).make(kernel, flags)
            try:
                wp.load_module(made.module, device=self._device, block_dim=group)
            except Exception as error:
                raise RuntimeError(f"{row.file}.py did not compile on {self.info.name}: {error}") from error
        return _Launch(self._device, made, row, group)


class _Launch:
    """Binds arguments by the signature table and launches.

    A recorded launch is kept, and a call sets what changed since the last one: a fraction of the time that a new
    launch takes. It knows buffers by their address, so it keeps none alive. Every thread has its own.
    """

    def __init__(self, device: wp.Device, kernel: wp.Kernel, row: Kernel, group: int) -> None:
        self._device, self._kernel, self._group = device, kernel, group
        self._binds = [_binding(argument) for argument in row.arguments]
        self._thread = threading.local()

    def __call__(self, size: tuple[int, ...], *arguments: Any) -> None:
        if 0 in size:
            return
        keys = [(value.ptr, value.size) if isinstance(value, wp.array) else value for value in arguments]
        recorded = getattr(self._thread, "recorded", None)
        if recorded is None:
            bound = [bind(value) for bind, value in zip(self._binds, arguments, strict=True)]
            command = wp.launch(
                self._kernel, dim=size[::-1], inputs=bound, device=self._device, block_dim=self._group, record_cmd=True
            )
        else:
            command, last_size, last_keys = recorded
            self._thread.recorded = None
            if size != last_size:
                command.set_dim(size[::-1])
            for i, (key, last) in enumerate(zip(keys, last_keys, strict=True)):
                if key != last:
                    command.set_param_at_index(i, self._binds[i](arguments[i]))
        command.launch()
        self._thread.recorded = (command, size, keys)


def _binding(argument: Argument) -> Callable[[Any], Any]:
    """What turns a value into an argument of a kernel."""
    if argument.shape is None:
        return float if argument.type in ("real", "double") else int
    return functools.partial(_view, width=argument.width)


def _view(buffer: wp.array, width: int) -> wp.array:
    """The buffer's memory as numbers or vectors; made once, kept by the buffer, and not its owner."""
    views = buffer.__dict__.setdefault("_gpusense_views", {})
    if width not in views:
        dtype = buffer.dtype if width == 1 else _VECTORS[buffer.dtype, width]
        shape = (buffer.size // width,)
        views[width] = wp.array(ptr=buffer.ptr, dtype=dtype, shape=shape, device=buffer.device)
    return views[width]


def _host(array: np.ndarray) -> wp.array:
    """A C-contiguous host array as Warp sees it, without a copy; the caller keeps it alive."""
    return wp.array(ptr=array.ctypes.data, dtype=_SCALARS[array.dtype], shape=(array.size,), device="cpu")


@functools.cache
def _initialize() -> None:
    """Start Warp without a word; that there is no CUDA driver is told by the list of devices."""
    with _settings(), _filtered_stderr():
        wp.init()


@contextlib.contextmanager
def _settings() -> Iterator[None]:
    """Warp without its greeting and progress, and without its cache where caches are off; then as it was before."""
    with _LOCK, contextlib.ExitStack() as stack:
        if hasattr(wp.config, "log_level"):
            changed: dict[str, Any] = {"log_level": max(wp.config.log_level, wp.LOG_WARNING)}
        else:
            changed = {"quiet": True}
        if cache_folder() is None and wp.config.kernel_cache_dir is not None:
            folder = tempfile.TemporaryDirectory(prefix="gpusense_", ignore_cleanup_errors=True)
            changed |= {"cache_kernels": False, "kernel_cache_dir": stack.enter_context(folder)}
        before = {name: getattr(wp.config, name) for name in changed}
        try:
            for name, value in changed.items():
                setattr(wp.config, name, value)
            yield
        finally:
            for name, value in before.items():
                setattr(wp.config, name, value)


@contextlib.contextmanager
def _filtered_stderr() -> Iterator[None]:
    """Hold back what native code writes to standard error, and pass on all but the absence of a CUDA driver."""
    try:
        saved = os.dup(2)
    except OSError:
        yield
        return
    with tempfile.TemporaryFile() as held:
        os.dup2(held.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            held.seek(0)
            for line in held:
                if _NO_DRIVER not in line:
                    os.write(2, line)
