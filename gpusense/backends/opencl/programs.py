"""Build OpenCL programs and keep them, and record launches whose arguments stay set."""

from __future__ import annotations

import contextlib
import functools
import importlib
import logging
import re
import sqlite3
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import pyopencl as cl

from gpusense._util.checks import show
from gpusense._util.interrupts import undisturbed
from gpusense.backends.base import BackendInfo, Recording, pluralize
from gpusense.backends.cache import discard_entry, load_entry, program_key, store_entry
from gpusense.backends.opencl import pocl
from gpusense.backends.opencl.memory import check_in_order, driver_errors, raise_clearly
from gpusense.interface.signatures import KERNELS
from gpusense.interface.sources import assemble, with_places

_ROUNDED_DIVISION = cl.device_fp_config.CORRECTLY_ROUNDED_DIVIDE_SQRT


class Programs:
    """The programs of a device, built or taken from the cache."""

    def __init__(self, info: BackendInfo, device: cl.Device, context: cl.Context) -> None:
        self.info, self._device, self._context = info, device, context
        # Programs with the keys of their entries in the cache.
        self._programs: dict[tuple[str, frozenset[str]], tuple[cl.Program, str]] = {}
        self.pocl = pocl.pocl_kernels() if pocl.is_pocl(device) else None
        self._of_bitcode = pocl.takes_bitcode(device)
        # Ranges are the same bits everywhere only if division is rounded correctly, an option on GPUs.
        rounded = bool(device.single_fp_config & _ROUNDED_DIVISION)
        self.options = ["-cl-fp32-correctly-rounded-divide-sqrt"] if rounded else []
        if self.pocl is not None:
            # PoCL would write the number of warnings to the terminal. Its hash of a kernel covers the options, not the
            # processor.
            self.options += ["-w", f"-DTARGET_{re.sub(r'[^a-z0-9]', '_', info.target)}"]

    def kernel(self, name: str, flags: frozenset[str]) -> tuple[cl.Kernel, Callable[[], None] | None]:
        """Return a new kernel object, and a function to call before its first launch; its program is built once."""
        file = KERNELS[name].file
        if (file, flags) not in self._programs:
            self._programs[file, flags] = self.build(file, flags)
        program, key = self._programs[file, flags]
        first = None if self.pocl is None else functools.partial(self.pocl.mark, key)
        return new_kernel(program, pocl.own_name(name, key) if self._of_bitcode else name), first

    def build(self, file: str, flags: frozenset[str]) -> tuple[cl.Program, str]:
        """Build the program of a kernel file; return it with its key in the cache."""
        source = assemble(file, flags)
        # Bitcode belongs to the version of LLVM, which the platform's version names.
        version = [self._device.platform.version] if self._of_bitcode else []
        options = [*self.options]
        registers = max(row.registers for row in KERNELS.values() if row.file == file)
        if registers and "IN_TEAMS" in flags and "NVIDIA" in self._device.vendor:
            options.append(f"-cl-nv-maxrregcount={registers}")
        key = program_key(self.info, source, [*options, *version])
        # PoCL's kernels are kept singly. For a binary, it would compile every kernel of the program for work-groups of
        # any size, which takes three times as long as the rest of the build.
        if self.pocl is None and (program := self._kept(key)) is not None:
            return program, key
        try:
            if self.pocl is not None and self._of_bitcode:
                return self._built_of_bitcode(self.pocl, file, source, key), key
            with contextlib.nullcontext() if self.pocl is None else self.pocl.building(key):
                program = self.built(cl.Program(self._context, source), options)
        except cl.RuntimeError as error:
            log = with_places(str(error), source)
            raise RuntimeError(f"{file}.cl did not compile on {self.info.name}: {log}") from error
        if self.pocl is None:
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
            lambda: self.built(cl.Program(self._context, source), options),
            lambda bitcode: self.built(cl.Program(self._context, [self._device], [bitcode]), options),
        )

    def _kept(self, key: str) -> cl.Program | None:
        """Return the program that an earlier run compiled; None if the driver accepts no stored one."""
        binary = load_entry(key)
        if binary is None:
            return None
        try:
            return self.built(cl.Program(self._context, [self._device], [binary]))
        except cl.Error:
            discard_entry(key)
            return None

    def built(self, program: cl.Program, options: list[str] | None = None) -> cl.Program:
        """Compile a program, or load its binary; ``options`` replace the device's."""
        with warnings.catch_warnings(), without_caches():
            # Some drivers write a log for every program; pyopencl shows it where PYOPENCL_COMPILER_OUTPUT is set.
            warnings.simplefilter("ignore", cl.CompilerWarning)
            return program.build(self.options if options is None else options, [self._device])


# ---- recordings: launches whose arguments stay set, each with a kernel object for itself


@dataclass(frozen=True)
class BoundLaunch:
    """A kernel with its arguments set, its size and group; keeps the arguments' memory alive."""

    kernel: cl.Kernel
    size: tuple[int, ...]
    group: tuple[int, ...]
    arguments: tuple[Any, ...]


class OpenCLRecording(Recording):
    """Launches that are enqueued together; a stream is a queue of the same context."""

    def __init__(self, queue: cl.CommandQueue, launches: list[BoundLaunch], count: Callable[[int], None]) -> None:
        self._queue, self._launches, self._count = queue, launches, count
        self._lock = threading.Lock()
        # Queues of users on which they were started since the last wait.
        self._used: list[cl.CommandQueue] = []

    def __call__(self, stream: Any = None) -> None:
        queue = self._queue if stream is None else self._checked(stream)
        # Before and after; see ``OpenCLBackend.enqueue``.
        self._count(len(self._launches))
        # The launches of two threads must not interleave.
        with self._lock:
            if stream is not None and queue not in self._used:
                self._used.append(queue)
            try:
                for launch in self._launches:
                    cl.enqueue_nd_range_kernel(queue, launch.kernel, launch.size, launch.group)
                # Flush: a driver may otherwise wait for further commands before it begins.
                queue.flush()
            except cl.Error as error:
                raise_clearly(error)
        self._count(len(self._launches))

    def __del__(self, run: Callable[[Callable[[], object]], None] = undisturbed) -> None:
        # As a default, the function is there when the interpreter ends and has emptied its modules.
        # Memory that is shared with the host must not go while a queue works on it.
        # An interrupt may come before there is one.
        if getattr(self, "_used", None):
            run(self._wait_for_all)

    def wait(self, *, elsewhere: bool = False) -> None:
        self._wait_for_all(elsewhere=elsewhere)
        with self._lock:
            self._used.clear()

    def _wait_for_all(self, *, elsewhere: bool = False) -> None:
        """Wait for the device's queue and for users' queues; repeated after an interrupt, it waits for all again."""
        with self._lock:
            used = [*self._used] if elsewhere else [self._queue, *self._used]
        with driver_errors():
            for queue in used:
                queue.finish()

    def explain(self) -> str:
        return f"{pluralize(len(self._launches), 'launch')} one by one, their arguments stay set: OpenCL has no graphs"

    def _checked(self, stream: Any) -> cl.CommandQueue:
        """Return a user's queue for the stream of a call."""
        same = isinstance(stream, cl.CommandQueue) and (stream.context, stream.device) == (
            self._queue.context,
            self._queue.device,
        )
        if not same:
            raise TypeError(f"stream: must be a queue of the model's context and device, got {show(stream)}")
        check_in_order(stream, "stream")
        return stream


# ---- switch pyopencl's caches off: a read-only folder or a damaged file would end the run


# True if pyopencl's caches are off; once it is imported it has no other switch.
_SWITCH = "_PYOPENCL_NO_CACHE"
_lock = threading.RLock()


def _open_database() -> None:
    """Import the module that opens the database; where that fails the caches are off for the whole process."""
    if getattr(cl, _SWITCH, True):
        return
    # An object whose construction failed reports that again when it is collected.
    hook, sys.unraisablehook = sys.unraisablehook, lambda *_: None
    try:
        importlib.import_module("pyopencl.invoker")
    except (ImportError, OSError, sqlite3.Error) as error:
        setattr(cl, _SWITCH, True)
        # Programs of gpusense are never kept there.
        logging.getLogger("gpusense").info("gpusense: pyopencl's cache cannot be used and is left out: %s", error)
        error.__traceback__ = None
    finally:
        sys.unraisablehook = hook


_open_database()


def new_kernel(program: Any, name: str) -> cl.Kernel:
    """Return a new kernel object of a program."""
    with without_caches():
        return cl.Kernel(program, name)


@contextlib.contextmanager
def without_caches() -> Iterator[None]:
    """Switch pyopencl's caches off, and restore them on leaving."""
    with _lock:
        before = getattr(cl, _SWITCH, None)
        if before is None:
            yield
            return
        setattr(cl, _SWITCH, True)
        try:
            yield
        finally:
            setattr(cl, _SWITCH, before)
