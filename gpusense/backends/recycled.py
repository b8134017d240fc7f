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


class ResultMemory:
    """Memory that waits for the next results."""

    def __init__(self) -> None:
        # Keyed by identity: a single step takes a block out, so no two threads take the same block.
        self._free: dict[int, np.ndarray] = {}

    def empty(self, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
        """Return an uninitialised array that shares its memory with no other array."""
        size = math.prod(shape) * dtype.itemsize
        if size < LEAST:
            return np.empty(shape, dtype)
        for block in [*self._free.values()][::-1]:
            if block.nbytes == size and self._free.pop(id(block), None) is not None:
                break
        else:
            block = np.empty(size, np.uint8)
        return np.asarray(Loan(self, block)).view(dtype).reshape(shape)

    def take_back(self, block: np.ndarray) -> None:
        """Keep the block of a freed result; the oldest blocks are dropped if there are too many."""
        self._free[id(block)] = block
        while len(self._free) > _MOST_BLOCKS or sum(one.nbytes for one in [*self._free.values()]) > _MOST_BYTES:
            self._free.pop(next(iter([*self._free]), 0), None)


class Loan:
    """The owner of a result's memory, as NumPy sees it: it gives the memory back when the last array is gone."""

    def __init__(self, memory: Any, block: Any) -> None:
        self._memory, self._block = weakref.ref(memory), block

    @property
    def __array_interface__(self) -> dict[str, Any]:
        interface: dict[str, Any] = self._block.__array_interface__
        return interface

    def __del__(self) -> None:
        memory = self._memory()
        if memory is not None:
            memory.take_back(self._block)
