"""Sum over all pairs on a device. Pairs are uploaded once; each pass downloads one row of sums per block."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense.backends import Backend
from gpusense.backends.base import Buffer
from gpusense.interface.flags import flags_if
from gpusense.interface.lanes import with_lanes_flag
from gpusense.interface.signatures import LANES
from gpusense.interface.structs import packed
from gpusense.learning.beam.pairs import Pairs
from gpusense.learning.beam.point import Point
from gpusense.models.scan.mixture import learning_terms

# Length of a row of sums, without and with second derivatives; see kernels/opencl/learning.cl.
_SUMS = {False: 13, True: 39}
# Largest number of blocks per pass, smallest number of pairs per block, and largest number of pairs in one buffer.
_BLOCKS = {"cpu": 4096, "gpu": 32768}
_SHORTEST = 16
_CHUNK = 1 << 26
_FLAGS = frozenset({"HIT", "SHORT", "RAND", "BIAS"})


@dataclass(frozen=True)
class _Chunk:
    """Pairs in one buffer on the device: ``blocks`` blocks of ``readings`` pairs, the last one padded with NaN."""

    reading: Any  # readings [m]
    expected: Any  # expected ranges [m]
    count: int
    blocks: int  # number of blocks
    readings: int  # pairs per block
    across: int  # stride from one block to the next
    along: int  # stride from one pair of a block to the next

    @property
    def layout(self) -> tuple[int, int, int, int]:
        """Layout arguments of the kernels."""
        return self.blocks, self.readings, self.across, self.along


class DeviceSums:
    """Pairs on a device, and sums over them; ``passes`` counts the passes so far."""

    def __init__(self, backend: Backend, real: np.dtype, pairs: Pairs) -> None:
        self._backend, self.real = backend, real
        self._range_max = pairs.range_max
        self._flags = _FLAGS | flags_if(FLOAT64=real == np.float64)
        self.passes = 0
        # The NumPy reference shares the processor's layout: it loops over the positions in a block, for all blocks at
        # once.
        gpu = backend.info.kind == "gpu"
        most = min(_CHUNK, backend.info.max_buffer // (8 * real.itemsize))
        self._chunks = [
            self._upload(pairs.reading[first : first + most], pairs.expected[first : first + most], gpu)
            for first in range(0, pairs.hits, most)
        ]
        self._most_blocks = max((chunk.blocks for chunk in self._chunks), default=0)
        self._rows = backend.empty(self._most_blocks * _SUMS[True], real) if self._chunks else None

    def _upload(self, reading: NDArray[np.floating], expected: NDArray[np.floating], gpu: bool) -> _Chunk:
        count = len(reading)
        length = max(_SHORTEST, -(-count // _BLOCKS["gpu" if gpu else "cpu"]))
        # On a processor lanes take adjacent pairs and are always full.
        length += 0 if gpu else -length % LANES
        blocks = -(-count // length)
        padded = np.full((2, blocks * length), np.nan, self.real)
        padded[0, :count], padded[1, :count] = reading, expected
        # On a GPU neighbouring work-items read neighbouring pairs; on a processor each reads a contiguous block.
        across, along = (1, blocks) if gpu else (length, 1)
        z, z_expected = (self._backend.upload(np.ascontiguousarray(row)) for row in padded)
        return _Chunk(z, z_expected, count, blocks, length, across, along)

    def of(self, pairs: Pairs) -> DeviceSums:
        """Return the sums over ``pairs`` on the same device."""
        return DeviceSums(self._backend, self.real, pairs)

    @property
    def selection(self) -> str:
        """The text that selects the device."""
        return self._backend.info.selection

    def _mixture(self, point: Point) -> tuple[Buffer, Buffer]:
        """Upload the numbers of the mixture and its table of masses for a set of parameters."""
        terms, masses = learning_terms(point.parameters(), self._range_max, self.real)
        return self._backend.upload(packed([terms], self.real)), self._backend.upload(masses)

    def sums(self, point: Point, *, information: bool = False) -> NDArray[np.float64]:
        """Sum over the hits in a fixed order: (13,) or, with second derivatives, (39,) float64."""
        width = _SUMS[information]
        flags = self._flags | point.shape.flags | flags_if(INFORMATION=information)
        total = np.zeros(width)
        self.passes += 1
        if not self._chunks:
            return total
        backend = self._backend
        launch = backend.compile("e_step", with_lanes_flag(backend.info.lanes, "e_step", flags))
        mixture = self._mixture(point)
        for chunk in self._chunks:
            launch((chunk.blocks,), chunk.reading, chunk.expected, *mixture, self._rows, *chunk.layout, width)
            rows = backend.download(self._rows, np.empty((chunk.blocks, width), self.real))
            total += np.ascontiguousarray(rows.T, np.float64).sum(axis=1)
        # Compensated sums convert the log p = -inf of an impossible pair to NaN.
        total[0] = -math.inf if math.isnan(total[0]) else total[0]
        return total

    def causes(self, point: Point) -> NDArray[np.float64]:
        """Return (M, 4) log p and the responsibilities of hit, short and rand for each hit."""
        backend = self._backend
        rows = [np.empty((0, 4))]
        mixture = self._mixture(point) if self._chunks else ()
        for chunk in self._chunks:
            out = backend.empty(4 * chunk.blocks * chunk.readings, self.real)
            launch = backend.compile("pair_causes", self._flags | point.shape.flags)
            launch((chunk.blocks,), chunk.reading, chunk.expected, *mixture, out, *chunk.layout)
            rows.append(backend.download(out, np.empty((chunk.count, 4), self.real)).astype(np.float64))
        return np.concatenate(rows)
