"""Arrays of pyopencl in a device's memory: taken as they are, and made of results."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array

from gpusense._checks import show
from gpusense.backends.base import Adopted, Buffer


def queue_of(given: object) -> cl.CommandQueue:
    """A user's queue, checked.

    Raises:
        ValueError: its commands may be done in another order than theirs.
    """
    assert isinstance(given, cl.CommandQueue)
    if given.properties & cl.command_queue_properties.OUT_OF_ORDER_EXEC_MODE_ENABLE:
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
    if first % alignment:
        raise ValueError(f"buffer: parts must begin at multiples of {alignment} bytes here, got {first}")
    return buffer.get_sub_region(first, size)


def adopted(array: Any, queue: cl.CommandQueue, selection: str, name: str, *, in_place: bool) -> Adopted:
    """See Sharing.adopt. What another queue was given to do with the array is waited for."""
    if array.context != queue.context:
        raise TypeError(
            f"{name}: must be of the context of {selection}'s queue, got an array of another: make the model with "
            "backend=<the array's queue>"
        )
    if not isinstance(array.dtype, np.dtype) or array.dtype.kind not in "fiu":
        raise TypeError(f"{name}: must hold real numbers, got {show(array.dtype)}")
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
            array = array.copy(queue=queue)
        buffer = part_of(array.base_data, array.offset, array.nbytes, alignment)
    held = array

    def to_host() -> np.ndarray:
        if contiguous:
            return np.asarray(held.get(queue=queue))
        whole = held.base_data
        numbers = np.empty(whole.size, np.uint8)
        cl.enqueue_copy(queue, numbers, whole)
        return np.ndarray(held.shape, held.dtype, numbers, held.offset, held.strides).copy()

    return Adopted(buffer, tuple(map(int, array.shape)), array.dtype, tuple(array.strides), contiguous, to_host, array)


def lent(buffer: cl.Buffer, queue: cl.CommandQueue, shape: tuple[int, ...], dtype: np.dtype) -> pyopencl.array.Array:
    """See Sharing.lend."""
    return pyopencl.array.Array(queue, shape, dtype, data=buffer if math.prod(shape) else None)
