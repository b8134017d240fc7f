"""Arrays of pyopencl in a device's memory: as inputs without a copy, and as results."""

from __future__ import annotations

import math
import sys
from typing import TYPE_CHECKING, Any

import numpy as np
import pyopencl as cl

from gpusense._util.checks import show
from gpusense.backends.base import Adopted, Buffer
from gpusense.backends.opencl.memory import SHARED, SharedPart, driver_errors

if TYPE_CHECKING:
    import pyopencl.array


def check_in_order(queue: cl.CommandQueue, name: str) -> None:
    """Refuse a queue that is not an in-order queue."""
    if queue.properties & cl.command_queue_properties.OUT_OF_ORDER_EXEC_MODE_ENABLE:
        raise ValueError(f"{name}: must be an in-order queue, got an out-of-order one")


def is_array(candidate: object) -> bool:
    """Return whether an object is an array of pyopencl."""
    module = sys.modules.get("pyopencl.array")
    return module is not None and isinstance(candidate, module.Array)


def alignment_of(device: cl.Device) -> int:
    """Return the alignment of parts of buffers [bytes]."""
    return max(int(device.mem_base_addr_align) // 8, 1)


def part_of(buffer: Buffer, first: int, size: int, alignment: int) -> Buffer:
    """Return ``size`` bytes of a buffer from byte ``first`` on, without a copy."""
    if first == 0 or size == 0:
        return buffer
    if isinstance(buffer, SHARED):
        return SharedPart(buffer, first, size)
    # A part cannot be divided into further parts.
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
    """Return a plain buffer for a buffer of a memory pool, which its array keeps alive; None for an empty array."""
    is_plain = buffer is None or isinstance(buffer, cl.Buffer)
    return buffer if is_plain else cl.Buffer.from_int_ptr(buffer.int_ptr, retain=True)


def adopted(array: Any, queue: cl.CommandQueue, selection: str, name: str, *, in_place: bool) -> Adopted:
    """See Backend.adopt. Wait for commands of another queue on the array."""
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
    source = array

    def to_host() -> np.ndarray:
        with driver_errors():
            if contiguous:
                return np.asarray(source.get(queue=queue))
            whole = _plain(source.base_data)
            numbers = np.empty(whole.size, np.uint8)
            cl.enqueue_copy(queue, numbers, whole)
        return np.ndarray(source.shape, source.dtype, numbers, source.offset, source.strides).copy()

    return Adopted(buffer, tuple(map(int, array.shape)), array.dtype, tuple(array.strides), contiguous, to_host, array)


def wrapped(buffer: cl.Buffer, queue: cl.CommandQueue, shape: tuple[int, ...], dtype: np.dtype) -> pyopencl.array.Array:
    """See Backend.wrap_external."""
    # Imported on use, since the import takes a while and NumPy arrays do not need it.
    import pyopencl.array

    return pyopencl.array.Array(queue, shape, dtype, data=buffer if math.prod(shape) else None)
