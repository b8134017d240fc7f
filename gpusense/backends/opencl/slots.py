"""Page-locked memory for large copies; see :mod:`gpusense.backends.staging`."""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np
import pyopencl as cl

from gpusense.backends.opencl.memory import driver_errors
from gpusense.backends.staging import Slot


class OpenCLSlot(Slot):
    """A piece of mapped host memory, copied by a queue."""

    def __init__(self, queue: cl.CommandQueue, memory: np.ndarray) -> None:
        self._queue, self.bytes = queue, memory
        self._copied: cl.Event | None = None

    def to_device(self, buffer: cl.Buffer, first: int, size: int) -> None:
        self._start(buffer, self.bytes[:size], dst_offset=first)

    def to_host(self, buffer: cl.Buffer, first: int, size: int) -> None:
        self._start(self.bytes[:size], buffer, src_offset=first)

    def wait(self) -> None:
        if self._copied is not None:
            with driver_errors():
                self._copied.wait()
            self._copied = None

    def _start(self, target: Any, source: Any, **offset: Any) -> None:
        """Enqueue a copy, and let the device begin."""
        with driver_errors():
            self._copied = cl.enqueue_copy(self._queue, target, source, is_blocking=False, **offset)
            self._queue.flush()


def slots_of(queue: cl.CommandQueue, number: int, size: int) -> list[OpenCLSlot]:
    """Allocate slots of a number of bytes each; their memory is unmapped before the queue goes, at the latest at exit.

    A process that ended with mapped memory crashed on NVIDIA's driver.
    """
    flags = cl.mem_flags.READ_WRITE | cl.mem_flags.ALLOC_HOST_PTR
    with driver_errors():
        buffer = cl.Buffer(queue.context, flags, number * size)
        access: Any = cl.map_flags.READ | cl.map_flags.WRITE
        mapped: Any = cl.enqueue_map_buffer(queue, buffer, access, 0, (number * size,), np.uint8)
    memory: np.ndarray = mapped[0]
    slots = [OpenCLSlot(queue, memory[first : first + size]) for first in range(0, number * size, size)]
    # All slots are freed together.
    weakref.finalize(slots[0], _unmap, queue, memory)
    return slots


def _unmap(queue: cl.CommandQueue, memory: np.ndarray) -> None:
    """Give mapped memory back."""
    queue.finish()
    mapping: Any = memory.base
    mapping.release(queue)
    queue.finish()
