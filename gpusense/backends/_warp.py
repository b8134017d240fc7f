"""Warp backend: NVIDIA GPUs through CUDA, and the processor.

Warp's last thread index runs fastest, a signature row's first axis does: launches pass their size reversed, and the
kernels unpack ``wp.tid()`` in that order.

Warp runs a launch on the processor in the calling thread. Large launches over particles are therefore cut into pieces,
each with its own part of the arrays, that threads of ours run side by side: Warp releases Python's lock while a kernel
runs, and its kernels keep no state. A particle's result does not depend on the piece.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import functools
import math
import os
import tempfile
import threading
from collections.abc import Callable, Hashable, Iterator
from typing import Any

import numpy as np
import warp as wp

from gpusense._kernel_files import warp_module
from gpusense.backends._numpy import _memory
from gpusense.backends._warp_queue import Graphs, Group, Queue
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
# The axes of a launch that threads may share, and the argument that counts each.
_SHARED = {"particle": "particles", "block": "blocks"}
_MOST_NUMBERS = (1 << 31) - 1
# Particles times beams that are worth a launch, some 0.4 ms of the fastest kernel, and pieces for each thread: threads
# that others hold up take fewer.
_PIECE_WORK = 1 << 16
_PIECES = 2
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
        self._gathers = self._device.is_cuda
        self._graphs = Graphs(self._device)
        # One for each thread of a call, and those that no call has now.
        self._thread = threading.local()
        self._queues: list[Queue] = []
        self._launchers: dict[tuple[str, frozenset[str]], Launcher] = {}
        self._asked: dict[tuple[str, frozenset[str]], Launcher] = {}

    def upload(self, array: np.ndarray, out: wp.array | None = None, *, wait: bool = True) -> wp.array:
        """See Backend.upload."""
        self.check_process()
        array = np.ascontiguousarray(array)
        buffer = self.empty(array.size, array.dtype) if out is None else out
        if array.size:
            queue = self.gathering()
            if queue is not None:
                if not wait and queue.upload(array, buffer):
                    return buffer
                self._flush(queue)
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
            queue = self.gathering()
            if queue is not None:
                if not wait and queue.download(buffer, out):
                    return out
                self._flush(queue)
            wp.copy(_host(out), buffer, count=out.size)
            if wait:
                self._wait()
        return out

    def part(self, buffer: wp.array, first: int, count: int) -> wp.array:
        """See Backend.part."""
        return buffer if (first, count) == (0, buffer.size) else buffer[first : first + count]

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
        queue = self.gathering()
        if queue is not None:
            self._flush(queue)
        self._wait()
        if queue is not None:
            queue.deliver()

    def gather(self) -> None:
        """See Gathering.gather."""
        if not self._gathers:
            return
        try:
            queue = self._queues.pop()
        except IndexError:
            queue = Queue(self._device, _SCALARS)
        if not queue.settled:
            # An error ended the call before, and something of it may be under way.
            self._wait()
        queue.begin()
        self._thread.queue = queue

    def start(self) -> None:
        """See Gathering.start."""
        queue = self.gathering()
        if queue is not None:
            self._flush(queue)

    def scatter(self) -> None:
        """See Gathering.scatter."""
        queue = self.gathering()
        if queue is not None:
            self._thread.queue = None
            try:
                self._flush(queue)
            finally:
                self._queues.append(queue)

    def mark(self) -> object | None:
        """See Gathering.mark."""
        queue = self.gathering()
        return None if queue is None else (queue.started, len(queue.steps))

    def kept(self, mark: object) -> object | None:
        """See Gathering.kept."""
        queue = self.gathering()
        assert queue is not None and isinstance(mark, tuple)
        started, first = mark
        steps = queue.steps[first:]
        if started != queue.started or not all(isinstance(step, _LaunchStep) for step in steps):
            return None
        group = Group([step.alone() for step in steps if isinstance(step, _LaunchStep)])
        queue.steps[first:] = [group]
        return group

    def repeat(self, kept: object) -> None:
        """See Gathering.repeat."""
        queue = self.gathering()
        assert queue is not None and isinstance(kept, Group)
        queue.steps.append(kept)

    def address(self, buffer: wp.array) -> int:
        """See Gathering.address."""
        return int(buffer.ptr or 0)

    def gathering(self) -> Queue | None:
        """What this thread gathers in, if it does."""
        return getattr(self._thread, "queue", None)

    def _flush(self, queue: Queue) -> None:
        """Start what was gathered."""
        if queue.steps:
            steps, queue.steps = queue.steps, []
            queue.started += 1
            self._graphs.start(steps)

    def _wait(self) -> None:
        """Wait for the current stream; the processor has none and works at once."""
        if self._device.is_cuda:
            wp.synchronize_stream(self._device)

    def _build(self, row: Kernel, kernel: str, flags: frozenset[str]) -> Launcher:
        group = row.group if self._device.is_cuda else 1
        with _settings():
            made = warp_module(row.file).make(kernel, flags)
            try:
                wp.load_module(made.module, device=self._device, block_dim=group)
            except Exception as error:
                raise RuntimeError(f"{row.file}.py did not compile on {self.info.name}: {error}") from error
        launch = _Launch(self._device, made, row, group, self.gathering)
        if self._device.is_cuda or _threads() == 1 or not _independent(row):
            return launch
        return _Pieces(launch, row)


class _Launch:
    """Binds arguments by the signature table and launches.

    A recorded launch is kept, and a call sets what changed since the last one: a fraction of the time that a new
    launch takes. It knows buffers by their address, so it keeps none alive. Every thread has its own.
    """

    def __init__(
        self,
        device: wp.Device,
        kernel: wp.Kernel,
        row: Kernel,
        group: int,
        gathering: Callable[[], Queue | None],
    ) -> None:
        self._device, self._kernel, self._group, self._gathering = device, kernel, group, gathering
        self._binds = [_binding(argument) for argument in row.arguments]
        self._thread = threading.local()

    def __call__(self, size: tuple[int, ...], *arguments: Any) -> None:
        if 0 in size:
            return
        keys = [(value.ptr, value.size) if isinstance(value, wp.array) else value for value in arguments]
        queue = self._gathering()
        if queue is None:
            self.start(size, arguments, keys, None)
        else:
            queue.steps.append(_LaunchStep(self, size, arguments, keys))

    def start(self, size: tuple[int, ...], arguments: tuple[Any, ...], keys: list[Any], stream: Any) -> None:
        """Launch on a stream, or on the device's current one; the keys are those of the arguments."""
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
        command.launch(stream)
        self._thread.recorded = (command, size, keys)


class _LaunchStep:
    """A launch that is gathered; see Step."""

    def __init__(self, launch: _Launch, size: tuple[int, ...], arguments: tuple[Any, ...], keys: list[Any]) -> None:
        self._given = (size, arguments, keys)
        self._launch = launch
        self.key: Hashable = (id(launch), size, *keys)

    def alone(self) -> _LaunchStep:
        """The same launch, which keeps no array alive."""
        size, arguments, keys = self._given
        own = [_slice(value, 0, value.size) if isinstance(value, wp.array) else value for value in arguments]
        return _LaunchStep(self._launch, size, tuple(own), keys)

    def start(self, stream: wp.Stream | None) -> None:
        """See Step.start."""
        self._launch.start(*self._given, stream)


def _shared_axis(row: Kernel) -> str | None:
    """The axis of a launch, particles or blocks of pairs, that threads may share."""
    return next((axis for axis in _SHARED if axis in row.launch), None)


def _has_rows(argument: Argument, axis: str) -> bool:
    """Whether an argument has one row for each index of an axis."""
    return argument.shape is not None and argument.shape.split(" ")[0] == _SHARED[axis]


def _independent(row: Kernel) -> bool:
    """Whether a kernel writes to nothing but the rows of its own particles or blocks."""
    axis = _shared_axis(row)
    return axis is not None and all(_has_rows(argument, axis) for argument in row.arguments if argument.output)


@functools.cache
def _threads() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@functools.cache
def _pool(process: int) -> concurrent.futures.ThreadPoolExecutor:
    """The threads of a process, all launches'; the calling thread works as well."""
    return concurrent.futures.ThreadPoolExecutor(_threads() - 1, "gpusense")


class _Pieces:
    """A launch over particles or blocks of pairs, cut into pieces that several threads take one after the other."""

    def __init__(self, launch: _Launch, row: Kernel) -> None:
        self._launch, self._row = launch, row
        self._name = _shared_axis(row) or ""
        self._axis = row.launch.index(self._name)
        self._count = next(i for i, argument in enumerate(row.arguments) if argument.name == _SHARED[self._name])
        self._work = [
            i for i, argument in enumerate(row.arguments) if argument.name in ("rays", "readings", "features")
        ]

    def __call__(self, size: tuple[int, ...], *arguments: Any) -> None:
        particles = size[self._axis]
        work = particles * max((int(arguments[i]) for i in self._work), default=1)
        count = min(_PIECES * _threads(), work // _PIECE_WORK, particles)
        if count < 2:
            self._launch(size, *arguments)
            return
        step = -(-particles // count)
        rows = self._rows(arguments)
        begins = iter(range(0, particles, step))
        lock = threading.Lock()

        def pieces() -> None:
            while True:
                with lock:
                    begin = next(begins, None)
                if begin is None:
                    return
                count = min(step, particles - begin)
                self._launch(
                    (*size[: self._axis], count, *size[self._axis + 1 :]), *self._piece(arguments, rows, begin, count)
                )

        helpers = []
        # Where there are no more threads to be had, those that there are do the work.
        with contextlib.suppress(RuntimeError):
            for _ in range(min(_threads(), count) - 1):
                helpers.append(_pool(os.getpid()).submit(pieces))
        try:
            pieces()
        finally:
            # Whatever happened, nobody may still write when this returns: what has not begun never does.
            with lock:
                begins = iter(())
            _finish(helpers)
        for helper in helpers:
            if not helper.cancelled():
                helper.result()

    def _rows(self, arguments: tuple[Any, ...]) -> list[tuple[int, int]]:
        """The arrays that hold something of every particle or block, and how many numbers of each."""
        named = {argument.name: value for argument, value in zip(self._row.arguments, arguments, strict=True)}
        found = []
        for i, argument in enumerate(self._row.arguments):
            if argument.shape is not None and _has_rows(argument, self._name):
                factors = argument.shape.split(" * ")[1:]
                each = math.prod(int(factor) if factor.isdigit() else int(named[factor]) for factor in factors)
                if arguments[i].size >= argument.width * each * arguments[self._count]:
                    found.append((i, argument.width * each))
        return found

    def _piece(self, arguments: tuple[Any, ...], rows: list[tuple[int, int]], begin: int, count: int) -> list[Any]:
        """The arguments of a launch of some particles."""
        cut = list(arguments)
        cut[self._count] = count
        for i, each in rows:
            cut[i] = _slice(arguments[i], begin * each, count * each)
        return cut


def _finish(helpers: list[concurrent.futures.Future[None]]) -> None:
    """Wait for all helpers, interrupted or not; those that have not begun are cancelled."""
    interrupted: BaseException | None = None
    for helper in helpers:
        helper.cancel()
    while any(not helper.done() for helper in helpers):
        try:
            concurrent.futures.wait(helpers)
        except KeyboardInterrupt as error:
            interrupted = error
    if interrupted is not None:
        raise interrupted


def _slice(buffer: wp.array, begin: int, count: int) -> wp.array:
    """Numbers of a buffer, without a copy; the caller keeps it alive."""
    start = buffer.ptr + begin * wp.types.type_size_in_bytes(buffer.dtype)
    return wp.array(ptr=start, dtype=buffer.dtype, shape=(count,), device=buffer.device)


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
