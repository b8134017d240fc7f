"""Parts of a filter's particles, and the messages that shards exchange."""

from __future__ import annotations

import itertools
from collections.abc import Generator, Sequence
from typing import Any, NamedTuple

import numpy as np

from gpusense.localization.sums import block_of

# A method of a shard, which yields once; poses with cumulative weights; the index of a sensor with its readings; the
# lowest and the highest mark of each shard's draws.
Step = Generator[None, None, Any]
Piece = tuple[np.ndarray, np.ndarray]
SensorReadings = tuple[int, tuple[Any, ...]]
Marks = Sequence[tuple[float, float]] | None


class Part(NamedTuple):
    """Particles of a shard.

    Attributes:
        first: Index of the first one in the whole filter.
        size: Number of particles.
        whole: Number of particles of the whole filter.
        block: Particles of a block of sums.
    """

    first: int
    size: int
    whole: int
    block: int


def parts_of(count: int, shards: int) -> list[Part]:
    """Split particles into parts of whole blocks, so that sums over blocks equal those on one device."""
    block = block_of(count)
    blocks = -(-count // block)
    ends = [min(blocks * shard // shards * block, count) for shard in range(shards + 1)]
    return [Part(one, two - one, count, block) for one, two in itertools.pairwise(ends)]


def finished(steps: Step) -> Any:
    """Run the second half of a method, and return its result."""
    try:
        next(steps)
    except StopIteration as end:
        return end.value
    raise AssertionError("a method of a shard yields once")
