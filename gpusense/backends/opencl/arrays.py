"""Arrays of pyopencl in a device's memory: taken as they are, and made of results."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array

from gpusense._util.checks import show
from gpusense.backends.base import Adopted, Buffer
from gpusense.backends.opencl.memory import driver_errors
from gpusense.backends.opencl.replay import is_unordered


def queue_of(given: object) -> cl.CommandQueue:
    """A user's queue, checked.

    Raises:
        ValueError: its commands may be done in another order than theirs.
    """
    assert isinstance(given, cl.CommandQueue)
    if is_unordered(given):
        raise ValueError("backend: must be a queue that does commands in their order, got one that does not")
    return given


def alignment_of(device: cl.Device) -> int:
    """Parts of buffers begin at multiples of so many bytes."""
    return max(int(device.mem_base_addr_align) // 8, 1)


def part_of(buffer: cl.Buffer, first: int, size: int, alignment: int) -> cl.Buffer:
    """Some bytes of a buffer.

    Raises:
        ValueError: the device cannot begin there.
    """
    if first == 0 or size == 0:
        return buffer
    # A part has no parts of its own.
    whole: Any = buffer.get_info(cl.mem_info.ASSOCIATED_MEMOBJECT)
    if whole is not None:
        begin: Any = buffer.get_info(cl.mem_info.OFFSET)
        first, buffer = first + begin, whole
    if first % alignment:
        raise ValueError(f"buffer: parts must begin at multiples of {alignment} bytes here, got {first}")
    with driver_errors():
        part: Any = buffer.get_sub_region(first, size)
    return part


def _plain(buffer: Any) -> Any:
    """A buffer of a memory pool, which its array keeps, as any other; an empty array has none."""
    known = buffer is None or isinstance(buffer, cl.Buffer)
    return buffer if known else cl.Buffer.from_int_ptr(buffer.int_ptr, retain=True)


def adopted(array: Any, queue: cl.CommandQueue, selection: str, name: str, *, in_place: bool) -> Adopted:
    """See Sharing.adopt. What another queue was given to do with the array is waited for."""
    if array.context != queue.context:
        raise TypeError(
            f"{name}: must be of the context of {selection}'s queue, got an array of another: make the model with "
            "backend=<the array's queue>"
        )
    if not isinstance(array.dtype, np.dtype) or array.dtype.kind not in "fiu":
        raise TypeError(f"{name}: must hold real numbers, got {show(array.dtype)}")
    if isinstance(array.base_data, cl.SVMPointer):
        raise TypeError(f"{name}: must be in a buffer, got an array in shared virtual memory")
    for event in array.events:
        event.wait()
    if array.queue is not None and array.queue != queue:
        array.queue.finish()
    contiguous = bool(array.flags.c_contiguous)
    buffer: Buffer = None
    if contiguous:
        alignment = alignment_of(queue.device)
        if array.offset % alignment and in_place:
            raise ValueError(
                f"{name}: must begin at a multiple of {alignment} bytes of its buffer on {selection}, got "
                f"{array.offset}: pass a copy"
            )
        if array.offset % alignment:
            with driver_errors():
                array = array.copy(queue=queue)
        buffer = part_of(_plain(array.base_data), array.offset, array.nbytes, alignment)
    held = array

    def to_host() -> np.ndarray:
        with driver_errors():
            if contiguous:
                return np.asarray(held.get(queue=queue))
            whole = _plain(held.base_data)
            numbers = np.empty(whole.size, np.uint8)
            cl.enqueue_copy(queue, numbers, whole)
        return np.ndarray(held.shape, held.dtype, numbers, held.offset, held.strides).copy()

    return Adopted(buffer, tuple(map(int, array.shape)), array.dtype, tuple(array.strides), contiguous, to_host, array)


def lent(buffer: cl.Buffer, queue: cl.CommandQueue, shape: tuple[int, ...], dtype: np.dtype) -> pyopencl.array.Array:
    """See Sharing.lend."""
    return pyopencl.array.Array(queue, shape, dtype, data=buffer if math.prod(shape) else None)
