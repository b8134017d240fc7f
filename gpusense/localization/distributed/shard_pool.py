"""Copies of all shards' particles on the device of one shard, which draws from them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gpusense.backends.base import Backend, Buffer
from gpusense.interface.launches import Program
from gpusense.localization.distributed.parts import Piece
from gpusense.localization.sums import Sums, block_of

_DOUBLE = np.dtype(np.float64)


class ShardPool:
    """Buffers on a device for poses, cumulative weights and certain copies of particles of all shards.

    Args:
        backend: The device.

    Attributes:
        poses: Poses.
        ends: Cumulative weights.
        count: Particles.
    """

    def __init__(self, backend: Backend) -> None:
        self._backend, self._capacity = backend, 0
        self.poses: Any = None
        self.ends: Any = None
        self.count = 0
        # For residual resampling: capacity, sums over blocks, and cumulative numbers of copies.
        self._counted: tuple[int, Any, Any] = (0, None, None)

    def reserve(self, count: int, whole: int) -> None:
        """Allocate buffers for ``count`` of the filter's ``whole`` particles."""
        self.count = count
        if count > self._capacity:
            self._capacity = count if count == whole else 2 * count
            self.poses, self.ends = (self._backend.empty(size * self._capacity, _DOUBLE) for size in (3, 1))

    def upload(self, pieces: Sequence[Piece], whole: int) -> None:
        """Copy particles of shards, in their order, from the host."""
        poses, ends = (np.ascontiguousarray(np.concatenate(one)) for one in zip(*pieces, strict=True))
        self.reserve(len(ends), whole)
        self._backend.upload(poses, self.poses)
        self._backend.upload(ends, self.ends)

    def take(self, poses: Buffer, ends: Buffer, first: int, count: int) -> None:
        """Copy particles from another device."""
        self._backend.copy(poses, self.poses, 3 * count * _DOUBLE.itemsize, to=3 * first * _DOUBLE.itemsize)
        self._backend.copy(ends, self.ends, count * _DOUBLE.itemsize, to=first * _DOUBLE.itemsize)

    def copies(self, state: Buffer, drawn: int, stage: int) -> tuple[Program, Buffer]:
        """Return the launches that count the certain copies of residual resampling, and the buffer of their results.

        Each device counts the copies of all particles.

        Args:
            state: State of the filter.
            drawn: Particles of the whole filter to draw.
            stage: The stage.
        """
        if self.count > self._counted[0]:
            size = self._capacity
            self._counted = size, Sums(self._backend, size), self._backend.empty(size, _DOUBLE)
        _, sums, copies = self._counted
        block = block_of(self.count)
        numbers = dict(ends=self.ends, state=state, particles=self.count, block=block, blocks=-(-self.count // block))
        return sums.copies(numbers, copies, drawn, stage), copies
