"""Sum over a filter's particles: first over blocks, then over groups of blocks, then over all.

A work-item adds up a block. Particles per block, blocks per group and groups are all about the cube root of the number
of particles; small clouds have one group. GPUs use more and smaller blocks of weights, since sums of weights are exact.
Sums of poses have the same blocks on every device; on GPUs a work-item adds up one lane of a block.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from gpusense.backends.base import Backend, Buffer
from gpusense.interface.constants import ESTIMATE_LANES, ESTIMATE_SUMS, WEIGHT_SUMS
from gpusense.interface.lanes import with_lanes_flag
from gpusense.interface.launches import Program, launch

_DOUBLE = np.dtype(np.float64)
_PLAIN = frozenset[str]()
# Particles per float64 vector; fewest particles per block; most blocks of a cloud with one group.
_VECTOR, _LEAST, MOST_BLOCKS = 8, 8, 128


def block_of(count: int) -> int:
    """Return the number of particles of a block, in whole vectors."""
    return max(math.ceil(round(count ** (1 / 3), 6) / _VECTOR) * _VECTOR, 2 * _LEAST)


def weight_block(backend: Backend, count: int) -> int:
    """Return the particles of a block of weights."""
    block = block_of(count)
    return block if backend.info.kind == "cpu" else max(block // (5 * _VECTOR), 1) * _VECTOR


def reduction_fans(blocks: int) -> tuple[int, ...]:
    """Return the rows per level of the reduction: blocks of a group, then groups; or all of a small cloud."""
    if blocks <= MOST_BLOCKS:
        return (blocks,)
    fan = math.isqrt(blocks - 1) + 1
    return fan, -(-blocks // fan)


class Sums:
    """Buffers of sums of at most ``capacity`` particles, and their launches."""

    def __init__(self, backend: Backend, capacity: int) -> None:
        self._backend, blocks = backend, -(-capacity // _LEAST)
        groups = math.isqrt(blocks) + 2
        # A block of poses has at least as many particles as the cube root of their number.
        moments = (math.ceil(capacity ** (2 / 3)) + 2) * ESTIMATE_SUMS
        # Largest score, and sums, of each block; sums of the weights of all particles.
        self.largest = backend.empty(blocks, _DOUBLE)
        self.rows = backend.empty(max(WEIGHT_SUMS * blocks, ESTIMATE_LANES * moments), _DOUBLE)
        self._joined = backend.empty(max(WEIGHT_SUMS * groups, moments), _DOUBLE)
        self._largest_of_groups, self._highest = backend.empty(groups, _DOUBLE), backend.empty(1, _DOUBLE)
        self.totals = backend.empty(WEIGHT_SUMS, _DOUBLE)

    def launch(self, kernel: str, size: int, **arguments: Any) -> Program:
        """Return a launch of a kernel, in lanes if the device uses them."""
        return (launch(kernel, with_lanes_flag(self._backend.info.lanes, kernel, _PLAIN), (size,), **arguments),)

    def highest(self, blocks: int) -> tuple[Program, Buffer, int]:
        """Return the launches for the largest score of each group, the buffer of results, and its length."""
        fan, *groups_of = reduction_fans(blocks)
        if not groups_of:
            return (), self.largest, blocks
        groups = groups_of[0]
        program = self.launch("join_scores", groups, scores=self.largest, largest=self._largest_of_groups,
                              blocks=blocks, fan=fan)  # fmt: skip
        return program, self._largest_of_groups, groups

    def weigh(self, numbers: dict[str, Any], scored: tuple[Buffer, int], stage: int) -> Program:
        """Return the launches that weigh particles, by the largest scores of a number of groups."""
        largest, groups = scored
        blocks = numbers["blocks"]
        weigh = self.launch("weigh_particles", blocks, largest=largest, groups=groups, sums=self.rows,
                            highest=self._highest, stage=stage, **numbers)  # fmt: skip
        return weigh + self._weight_totals(blocks)

    def set_weights(self, numbers: dict[str, Any], place: tuple[int, int], out: tuple[Buffer, Buffer]) -> Program:
        """Return the launch that writes weights and their cumulative sums after weighing, for a stage of all stages."""
        (stage, stages), (weight, ends), blocks = place, out, numbers["blocks"]
        return self.launch("set_weights", blocks + 1, highest=self._highest, sums=self.rows, joined=self._joined,
                           totals=self.totals, fan=reduction_fans(blocks)[0], stage=stage, stages=stages, weight=weight,
                           ends=ends, **numbers)  # fmt: skip

    def copies(self, numbers: dict[str, Any], copies: Buffer, drawn: int, stage: int) -> Program:
        """Return the launches that add up certain copies of residual resampling; they overwrite the sums of weights."""
        blocks = numbers["blocks"]
        return (
            *self.launch("count_copies", blocks, sums=self.rows, drawn=drawn, stage=stage, **numbers),
            *self._weight_totals(blocks),
            *self.launch("set_copies", blocks, sums=self.rows, joined=self._joined, copies=copies,
                         fan=reduction_fans(blocks)[0], drawn=drawn, stage=stage, **numbers),
        )  # fmt: skip

    def estimate(
        self, poses: Buffer, weight: Buffer, estimate: Buffer, count: int, refined: Buffer | None = None
    ) -> Program:
        """Return the launches that write the estimate of a cloud, or by a second pass the numbers in ``refined``."""
        second_pass, target_of_pass = (0, estimate) if refined is None else (1, refined)
        info, block = self._backend.info, block_of(count)
        # In a kernel with lanes, a work-item processes all lanes.
        lanes = ESTIMATE_LANES if info.kind == "cpu" or info.lanes > 1 else 1
        blocks, each = -(-count // block), ESTIMATE_LANES // lanes
        program = self.launch("sum_poses", blocks * each, poses=poses, weight=weight, estimate=estimate,
                              sums=self.rows, particles=count, block=block, lanes=lanes,
                              second_pass=second_pass)  # fmt: skip
        # finish_estimate adds up the groups; on GPUs a further join is faster.
        fans = (each, *reduction_fans(blocks)) if each > 1 else reduction_fans(blocks)[:-1]
        source, target, groups = self.rows, self._joined, blocks * each
        for fan in fans:
            launches, groups = self._join(source, target, (groups, ESTIMATE_SUMS), fan)
            program += launches
            source, target = target, source
        return program + self.launch("finish_estimate", 1, poses=poses, sums=source, estimate=target_of_pass,
                                     groups=groups, second_pass=second_pass)  # fmt: skip

    def _weight_totals(self, blocks: int) -> Program:
        """Return the launches that add up the rows of weights of groups, and of all groups."""
        program: Program = ()
        source, shape = self.rows, (blocks, WEIGHT_SUMS)
        *inner, last = reduction_fans(blocks)
        for fan in inner:
            program, rows = self._join(source, self._joined, shape, fan)
            source, shape = self._joined, (rows, WEIGHT_SUMS)
        return program + self._join(source, self.totals, shape, last)[0]

    def _join(self, sums: Buffer, joined: Buffer, shape: tuple[int, int], fan: int) -> tuple[Program, int]:
        """Return the launch that adds up (rows, columns) sums in groups of ``fan``, and the number of groups."""
        rows, columns = shape
        groups = -(-rows // fan)
        launches = self.launch("join_rows", groups * columns, sums=sums, joined=joined, rows=rows, columns=columns,
                               fan=fan)  # fmt: skip
        return launches, groups
