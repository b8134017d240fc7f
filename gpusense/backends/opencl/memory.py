"""Memory of an OpenCL device, arrays of pyopencl in it, and the errors of its driver."""

from __future__ import annotations

import ctypes
import math
import sys
import weakref
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
import pyopencl as cl

from gpusense._util.checks import show
from gpusense._util.interrupts import undisturbed
from gpusense._util.memory import prefer_large_pages
from gpusense.backends.base import Adopted, Buffer
from gpusense.backends.processor import Slot

if TYPE_CHECKING:
    import pyopencl.array

_LOST = ("DEVICE_NOT_AVAILABLE", "INVALID_COMMAND_QUEUE", "INVALID_CONTEXT", "INVALID_DEVICE")
_OUT_OF_MEMORY = ("OUT_OF_RESOURCES", "MEM_OBJECT_ALLOCATION_FAILURE", "OUT_OF_HOST_MEMORY", "INVALID_BUFFER_SIZE")
# Bytes: a cache line, and at least the alignment of each type of a kernel.
_ALIGNMENT = 128


class DeviceBuffer(cl.Buffer):
    """A buffer in the device's memory."""


class SharedBuffer(cl.SVMAllocation):
    """Memory that host and device share.

    ``bytes``: the memory as an array of the host; ``view``: for copies, which take a third of the time of the array's.
    """

    def __init__(self, context: cl.Context, size: int, settle: Callable[[], None]) -> None:
        flags = cl.svm_mem_flags.READ_WRITE | cl.svm_mem_flags.SVM_FINE_GRAIN_BUFFER
        super().__init__(context, size, _ALIGNMENT, flags)
        prefer_large_pages(self.svm_ptr, size)
        # By address: an attribute that is a view of this object would be a cycle.
        self.bytes: np.ndarray = np.ctypeslib.as_array((ctypes.c_uint8 * size).from_address(self.svm_ptr))
        self.view = self.bytes.data
        self._settle = settle

    def __del__(self, run: Callable[[Callable[[], object]], None] = undisturbed) -> None:
        # As a default, the function is there when the interpreter ends and has emptied its modules.
        # The driver does not keep it alive for queued commands, as it does a buffer. Freed through the queue, as
        # pyopencl can also do, it ended in a corrupted heap with PoCL 3. The attribute is missing without an
        # allocation.
        if (settle := getattr(self, "_settle", None)) is not None:
            run(settle)


class SharedPart(cl.SVM):  # type: ignore[type-arg]
    """A part of memory that host and device share; see ``SharedBuffer``."""

    def __init__(self, whole: SharedBuffer | SharedPart, first: int, size: int) -> None:
        self.bytes: np.ndarray = whole.bytes[first : first + size]
        self.view = self.bytes.data
        super().__init__(self.bytes)
        self._whole = whole


SHARED = (SharedBuffer, SharedPart)


def raise_clearly(error: cl.Error) -> NoReturn:
    """Raise a driver's error as MemoryError, as RuntimeError if the device is lost, or unchanged."""
    if any(code in str(error) for code in _OUT_OF_MEMORY):
        raise MemoryError(f"the OpenCL device is out of memory: {error}") from error
    if any(code in str(error) for code in _LOST):
        raise RuntimeError(f"the OpenCL device is no longer available, make a new model: {error}") from error
    raise error


class driver_errors:
    """Context in which ``raise_clearly`` raises the driver's codes."""

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, cl.Error):
            raise_clearly(error)


# ---- page-locked memory for large copies; see :mod:`gpusense.backends.processor`


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


# ---- arrays of pyopencl in a device's memory: as inputs without a copy, and as results


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
        # Only an array that begins inside its buffer needs the alignment, which the device must be asked for.
        alignment = alignment_of(queue.device) if array.offset else 1
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

    strides = None if contiguous else tuple(array.strides)
    return Adopted(buffer, tuple(map(int, array.shape)), array.dtype, to_host, array, strides)


def wrapped(buffer: cl.Buffer, queue: cl.CommandQueue, shape: tuple[int, ...], dtype: np.dtype) -> pyopencl.array.Array:
    """See Backend.wrap_external."""
    # Imported on use, since the import takes a while and NumPy arrays do not need it.
    import pyopencl.array

    count = math.prod(shape)
    data = buffer if count else None
    strides = tuple(dtype.itemsize * max(math.prod(shape[axis + 1 :]), 1) for axis in range(len(shape)))
    try:
        # Without checks, which take as long as a launch.
        return pyopencl.array.Array(
            None, shape, dtype, data=data, strides=strides, _fast=True, _size=count, _context=queue.context,
            _queue=queue,
        )  # fmt: skip
    except TypeError:
        return pyopencl.array.Array(queue, shape, dtype, data=data)


# ---- properties of devices


def shares_memory(device: cl.Device) -> bool:
    """Return whether host and device may access the same memory between commands, and both are near it."""
    try:
        if not device.type & cl.device_type.CPU or not device.host_unified_memory:
            return False
        return bool(device.svm_capabilities & cl.device_svm_capabilities.FINE_GRAIN_BUFFER)
    except cl.Error:
        return False


def group_multiple(kernel: cl.Kernel, device: cl.Device) -> int:
    """Return the number of which the size of a kernel's work-groups must be a multiple.

    Mesa's llvmpipe computes work-items in vectors. A loop goes on while it would in a lane without a work-item, where
    reads return 0; such a loop may never end, and uses up the iterations of all loops of its group.
    """
    if not device.name.startswith("llvmpipe"):
        return 1
    return int(kernel.get_work_group_info(cl.kernel_work_group_info.PREFERRED_WORK_GROUP_SIZE_MULTIPLE, device))
