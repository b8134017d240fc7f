"""Launches of one OpenCL kernel: arguments bound by the signature table."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import pyopencl as cl

from gpusense.backends.opencl.caches import new_kernel, without_caches
from gpusense.backends.opencl.memory import driver_errors
from gpusense.backends.opencl.replay import KeptLaunch
from gpusense.interface.signatures import Kernel, lanes_of


class Enqueuer(Protocol):
    """What queues launches, or keeps them."""

    def enqueue(self, kernel: cl.Kernel, size: tuple[int, ...], group: tuple[int, ...]) -> None:
        """Queue a launch of a kernel whose arguments are set."""

    def recording(self) -> list[KeptLaunch] | None:
        """Where this thread keeps launches in place of starting them, if it does."""


class Launch:
    """Binds arguments by the signature table and enqueues."""

    def __init__(
        self,
        backend: Enqueuer,
        kernel: cl.Kernel,
        row: Kernel,
        flags: frozenset[str],
        first: Callable[[], None] | None = None,
    ) -> None:
        self._backend, self._kernel = backend, kernel
        # Called once, before the kernel is launched for the first time.
        self._first = first
        self._lanes, self._group = (1, row.group)
        if "WIDE" in flags:
            self._lanes, self._group = (lanes_of(flags) if row.wide else 1), row.wide_group
        self._lock = threading.Lock()
        real = np.dtype(np.float64 if "FLOAT64" in flags else np.float32)
        # Told the types, pyopencl sets all arguments in 1 us; a single number without takes it 6 us.
        self._types = [a.dtype(real).type if a.shape is None else None for a in row.arguments]
        with without_caches():
            kernel.set_arg_types(self._types)

    def __call__(self, size: tuple[int, ...], *arguments: Any) -> None:
        """See Launcher.__call__."""
        group = (self._group, *(1 for _ in size[1:]))
        rounded = (-(-size[0] // (self._lanes * group[0])) * group[0], *size[1:])
        # Arguments belong to the kernel object, so two threads must not interleave here.
        if self._first is not None:
            self._first()
            self._first = None
        kept = self._backend.recording()
        if kept is not None:
            own = new_kernel(self._kernel.program, self._kernel.function_name)
            with without_caches():
                own.set_arg_types(self._types)
            own.set_args(*arguments)
            kept.append(KeptLaunch(own, rounded, group, arguments))
            return
        with self._lock, driver_errors():
            self._kernel.set_args(*arguments)
            self._backend.enqueue(self._kernel, rounded, group)
