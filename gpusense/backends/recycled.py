"""Memory of large results on the host, which later results of the same size reuse.

A new array of 144 MB costs some 35 000 page faults, which take several times as long as the copy of the ranges into it.
Therefore the memory of a result returns to its device's store when the last array on it is freed.
"""

from __future__ import annotations

import math
import weakref
from typing import Any

import numpy as np

# Least size of a result whose memory is kept [bytes]; largest number and total size [bytes] of blocks that wait for
# reuse.
LEAST, _MOST_BLOCKS, _MOST_BYTES = 1 << 20, 2, 512 << 20


class FreedMemory:
    """Blocks of bytes that wait for the next results, at most a number and a total size [bytes] of them."""

    def __init__(self, most: int, most_bytes: int) -> None:
        self._most, self._most_bytes = most, most_bytes
        # Keyed by identity: a single step takes a block out, so no two threads take the same block.
        self._free: dict[int, Any] = {}

    def take(self, size: int) -> Any:
        """Return the newest block of a size, which no array uses any more; None without one."""
        for block in [*self._free.values()][::-1]:
            if block.size == size and self._free.pop(id(block), None) is not None:
                return block
        return None

    def take_back(self, block: Any) -> None:
        """Keep the block of a freed result; the oldest blocks are dropped if there are too many."""
        self._free[id(block)] = block
        while len(self._free) > self._most or sum(one.size for one in [*self._free.values()]) > self._most_bytes:
            self._free.pop(next(iter([*self._free]), 0), None)


class ResultMemory(FreedMemory):
    """Memory of results on the host."""

    def __init__(self) -> None:
        super().__init__(_MOST_BLOCKS, _MOST_BYTES)

    def empty(self, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
        """Return an uninitialised array that shares its memory with no other array."""
        size = math.prod(shape) * dtype.itemsize
        if size < LEAST:
            return np.empty(shape, dtype)
        block = self.take(size)
        return np.asarray(Loan(self, np.empty(size, np.uint8) if block is None else block)).view(dtype).reshape(shape)


class Loan:
    """The owner of a result's memory, as NumPy sees it: it gives the memory back when the last array is gone."""

    def __init__(self, memory: FreedMemory, block: Any) -> None:
        self._memory, self._block = weakref.ref(memory), block

    @property
    def __array_interface__(self) -> dict[str, Any]:
        interface: dict[str, Any] = self._block.__array_interface__
        return interface

    def __del__(self) -> None:
        memory = self._memory()
        if memory is not None:
            memory.take_back(self._block)
