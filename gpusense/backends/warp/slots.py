"""Page-locked memory for large copies; see :mod:`gpusense.backends.staging`."""

from __future__ import annotations

import warp as wp

from gpusense.backends.staging import Slot


class WarpSlot(Slot):
    """A piece of page-locked memory, copied on the device's current stream."""

    def __init__(self, device: wp.Device, memory: wp.array, first: int, size: int) -> None:
        self._device, self._memory, self._first = device, memory, first
        self.bytes = memory.numpy()[first : first + size]
        self._copied = wp.Event(device)
        self._busy = False

    def to_device(self, buffer: wp.array, first: int, size: int) -> None:
        wp.copy(self._part_of(buffer, first, size), self._memory, src_offset=self._first, count=size)
        self._started()

    def to_host(self, buffer: wp.array, first: int, size: int) -> None:
        wp.copy(self._memory, self._part_of(buffer, first, size), dest_offset=self._first, count=size)
        self._started()

    def wait(self) -> None:
        if self._busy:
            wp.synchronize_event(self._copied)
            self._busy = False

    def _started(self) -> None:
        """Note the end of the copy on the stream."""
        self._device.stream.record_event(self._copied)
        self._busy = True

    def _part_of(self, buffer: wp.array, first: int, size: int) -> wp.array:
        """Return some bytes of a buffer whose size in bytes exceeds the elements of a Warp array."""
        return wp.array(ptr=buffer.ptr + first, dtype=wp.uint8, shape=(size,), device=self._device)


def slots_of(device: wp.Device, number: int, size: int) -> list[WarpSlot]:
    """Allocate slots of a number of bytes each."""
    memory = wp.empty(number * size, dtype=wp.uint8, device="cpu", pinned=True)
    return [WarpSlot(device, memory, first, size) for first in range(0, number * size, size)]
