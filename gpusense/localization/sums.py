"""Sums over the particles of a filter: of blocks, of groups of blocks, and of all.

A work-item adds up a block, so blocks, their number in a group and the number of groups are alike: the cube root of the
number of particles. Small clouds have one group. GPUs take smaller blocks of weights, whose sums are exact; sums of
poses have the same blocks everywhere.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from gpusense.backends.base import Backend, Buffer
from gpusense.interface.constants import ESTIMATE_SUMS, WEIGHT_SUMS
from gpusense.interface.lanes import widened
from gpusense.interface.launches import Program, launch

_DOUBLE = np.dtype(np.float64)
_PLAIN = frozenset[str]()
# Particles of a vector of float64, the fewest of a block, and the most blocks that one work-item adds up.
_VECTOR, _LEAST, MOST_BLOCKS = 8, 8, 128


def block_of(count: int) -> int:
    """Return the particles of a block, in whole vectors."""
    return max(math.ceil(round(count ** (1 / 3), 6) / _VECTOR) * _VECTOR, 2 * _LEAST)


def weight_block(backend: Backend, count: int) -> int:
    """Return the particles of a block of weights."""
    return block_of(count) if backend.info.kind == "cpu" else block_of(count) // 2


def fans_of(blocks: int) -> tuple[int, ...]:
    """Return the rows that are added up in turn: blocks of a group, then groups; or all blocks of a small cloud."""
    if blocks <= MOST_BLOCKS:
        return (blocks,)
    fan = math.isqrt(blocks - 1) + 1
    return fan, -(-blocks // fan)


class Sums:
    """Buffers of sums, and the launches that fill them.

    Args:
        backend: The device.
        capacity: Most particles.

    Attributes:
        largest: Largest score of each block.
        rows: Sums of each block.
        totals: Sums of the weights of all particles.
    """

    def __init__(self, backend: Backend, capacity: int) -> None:
        self._backend, blocks = backend, -(-capacity // _LEAST)
        groups = math.isqrt(blocks) + 2
        self.largest, self.rows = (backend.empty(size * blocks, _DOUBLE) for size in (1, WEIGHT_SUMS))
        self._highest, self._joined = (backend.empty(size * groups, _DOUBLE) for size in (1, WEIGHT_SUMS))
        self.totals, self._moments = backend.empty(WEIGHT_SUMS, _DOUBLE), backend.empty(ESTIMATE_SUMS, _DOUBLE)

    def launch(self, kernel: str, size: int, **arguments: Any) -> Program:
        """Return a launch of a kernel, in lanes where the device asks for them."""
        return (launch(kernel, widened(self._backend.info.lanes, kernel, _PLAIN), (size,), **arguments),)

    def highest(self, blocks: int) -> tuple[Program, Buffer, int]:
        """Return the launches that find the largest score of each group; their results, and the number of them."""
        fan, *groups_of = fans_of(blocks)
        if not groups_of:
            return (), self.largest, blocks
        groups = groups_of[0]
        program = self.launch("join_scores", groups, scores=self.largest, largest=self._highest, blocks=blocks, fan=fan)
        return program, self._highest, groups

    def weigh(self, numbers: dict[str, Any], scored: tuple[Buffer, int], stage: int) -> Program:
        """Return the launches that weigh particles.

        Args:
            numbers: Arguments by name: score, before, settings, state, particles, block, blocks.
            scored: Largest scores of groups, and the number of groups.
            stage: The stage.
        """
        largest, groups = scored
        blocks = numbers["blocks"]
        weigh = self.launch("weigh_particles", blocks, largest=largest, groups=groups, sums=self.rows, stage=stage,
                            **numbers)  # fmt: skip
        return weigh + self._join(WEIGHT_SUMS, blocks, self.totals)

    def set_weights(
        self, numbers: dict[str, Any], scored: tuple[Buffer, int], place: tuple[int, int], out: tuple[Buffer, Buffer]
    ) -> Program:
        """Return the launch that sets weights.

        Args:
            numbers: Arguments by name, as for the weighing.
            scored: Largest scores of groups, and the number of groups.
            place: The stage, and the most stages.
            out: Receive the weights and their cumulative sums.
        """
        (largest, groups), (stage, stages), (weight, ends), blocks = scored, place, out, numbers["blocks"]
        return self.launch("set_weights", blocks, largest=largest, groups=groups, sums=self.rows,
                           joined=self._joined, totals=self.totals, fan=fans_of(blocks)[0], stage=stage,
                           stages=stages, weight=weight, ends=ends, **numbers)  # fmt: skip

    def copies(self, numbers: dict[str, Any], copies: Buffer, drawn: int, stage: int) -> Program:
        """Return the launches that add up the certain copies of residual resampling; the sums of weights are lost.

        Args:
            numbers: Arguments by name: ends, state, particles, block, blocks.
            copies: Receives their cumulative numbers.
            drawn: Particles to draw.
            stage: The stage.
        """
        blocks = numbers["blocks"]
        return (
            *self.launch("count_copies", blocks, sums=self.rows, drawn=drawn, stage=stage, **numbers),
            *self._join(WEIGHT_SUMS, blocks, self.totals),
            *self.launch("set_copies", blocks, sums=self.rows, joined=self._joined, copies=copies,
                         fan=fans_of(blocks)[0], drawn=drawn, stage=stage, **numbers),
        )  # fmt: skip

    def estimate(self, poses: Buffer, weight: Buffer, estimate: Buffer, count: int, again: int = 0) -> Program:
        """Return the launches that write the estimate of a cloud, or those of its second pass."""
        block = block_of(count)
        blocks = -(-count // block)
        return (
            *self.launch("sum_poses", blocks, poses=poses, weight=weight, estimate=estimate, sums=self.rows,
                         particles=count, block=block, again=again),
            *self._join(ESTIMATE_SUMS, blocks, self._moments),
            *self.launch("finish_estimate", 1, poses=poses, sums=self._moments, estimate=estimate, again=again),
        )  # fmt: skip

    def _join(self, columns: int, blocks: int, total: Buffer) -> Program:
        """Return the launches that add up the rows of groups, and of all groups."""
        program: Program = ()
        source, fans = self.rows, fans_of(blocks)
        for level, fan in enumerate(fans):
            last = level + 1 == len(fans)
            joined, groups = total if last else self._joined, -(-blocks // fan)
            program += self.launch("join_rows", groups * columns, sums=source, joined=joined, rows=blocks,
                                   columns=columns, fan=fan)  # fmt: skip
            source, blocks = joined, groups
        return program
