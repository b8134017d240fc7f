"""Device buffers of poses, scans and results, kept between calls: the steady state allocates nothing."""

from __future__ import annotations

import numpy as np

from gpusense.backends.base import Backend, Buffer


class Workspace:
    """Named buffers that only grow."""

    def __init__(self, backend: Backend) -> None:
        self._backend = backend
        self._buffers: dict[tuple[str, np.dtype], tuple[int, Buffer]] = {}

    def empty(self, name: str, count: int, dtype: np.dtype) -> Buffer:
        """A buffer of at least ``count`` numbers; what it held is lost."""
        dtype = np.dtype(dtype)
        capacity, buffer = self._buffers.get((name, dtype), (0, None))
        if buffer is None or capacity < count:
            self._buffers.pop((name, dtype), None)
            capacity = max(count, capacity + capacity // 2, 1)
            buffer = None
            buffer = self._backend.empty(capacity, dtype)
            self._buffers[name, dtype] = (capacity, buffer)
        return buffer

    def upload(self, name: str, array: np.ndarray) -> Buffer:
        """Copy a host array into the head of a named buffer."""
        return self._backend.upload(array, self.empty(name, array.size, array.dtype))

    def release(self) -> None:
        """Give the memory back; the next call allocates anew."""
        self._buffers.clear()
