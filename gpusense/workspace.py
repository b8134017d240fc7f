"""Device buffers of poses, scans and results, kept between calls: the steady state allocates nothing."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import numpy as np

from gpusense.backends.base import Backend, Buffer, Gathering


class Workspace:
    """Named buffers that only grow."""

    def __init__(self, backend: Backend) -> None:
        self._backend = backend
        self._buffers: dict[tuple[str, np.dtype], tuple[int, Buffer]] = {}
        # Host arrays that copies under way read or write.
        self._busy: list[np.ndarray] = []
        self._gather: Callable[[], None] | None = getattr(backend, "gather", None)

    def __enter__(self) -> Workspace:
        """Begin a call: where that is faster, the device may do all that it starts in one go."""
        if self._gather is not None:
            self._gather()
        return self

    def __exit__(self, *error: object) -> None:
        if self._gather is not None:
            cast(Gathering, self._backend).scatter()

    def empty(self, name: str, count: int, dtype: np.dtype, *, zero: bool = False) -> Buffer:
        """A buffer of at least ``count`` numbers; what it held is lost. A new one is cleared where asked."""
        capacity, buffer = self._buffers.get((name, dtype), (0, None))
        if buffer is None or capacity < count:
            self._buffers.pop((name, dtype), None)
            capacity = max(count, capacity + capacity // 2, 1)
            buffer = None
            buffer = self._backend.empty(capacity, dtype, zero=zero)
            self._buffers[name, dtype] = (capacity, buffer)
        return buffer

    def upload(self, name: str, array: np.ndarray) -> Buffer:
        """Start to copy a host array, which nobody may change until ``wait``, into the head of a named buffer."""
        array = np.ascontiguousarray(array)
        self._busy.append(array)
        return self._backend.upload(array, self.empty(name, array.size, array.dtype), wait=False)

    def download(self, buffer: Buffer, out: np.ndarray) -> None:
        """Start to copy the head of a buffer into a C-contiguous array, which is filled after ``wait``."""
        self._busy.append(out)
        self._backend.download(buffer, out, wait=False)

    def wait(self) -> None:
        """Wait for all copies and launches."""
        self._backend.synchronize()
        self._busy.clear()

    def release(self, keep: str = "") -> None:
        """Wait, and give the memory back, but for that of one name; the next call allocates anew."""
        self.wait()
        self._buffers = {key: kept for key, kept in self._buffers.items() if key[0] == keep}
