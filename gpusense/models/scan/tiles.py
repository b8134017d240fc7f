"""Launches for GPUs: tiles of particles and rays, the order of particles, and sums of parts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from gpusense.backends.base import Buffer
from gpusense.backends.workspace import Workspace
from gpusense.interface.constants import ALL_BINS, BLOCK_TERMS, STRETCH, TILE, TILE_PARTICLES, TILE_RAYS
from gpusense.interface.flags import flags_if
from gpusense.interface.launches import Launch, Program, launch
from gpusense.models.poses import PlacedPoses

_INT = np.dtype(np.int32)
_UNBOUNDED = np.full(7, -(1 << 31), _INT)
# Least particle-beams, and least particles, for which sorting saves more time than it takes.
LEAST_ORDERED = (1 << 22, 1 << 12)
# Least rays of a pose in worlds for which a warp takes rays of one pose instead of a tile: the poses are not
# sorted, and their rays meet other shapes.
LEAST_OF_ONE_POSE = 32
# Number of work-items that fill any device.
ENOUGH = 1 << 21
# The same for the likelihood field: its short work-items have a relatively costly start.
ENOUGH_SHORT = 1 << 19


@dataclass(frozen=True)
class Order:
    """An order of the particles that makes neighbouring rays coherent; see the kernel file ``order``."""

    placed: PlacedPoses
    bounds: Buffer
    bins: Buffer
    bin_of: Buffer
    order: Buffer
    flags: frozenset[str]

    def launches(self) -> Program:
        """Return the launches that compute the order."""
        count, poses = self.placed.count, dict(pose_cell=self.placed.cell, pose=self.placed.pose)
        bins = dict(bounds=self.bounds, bins=self.bins)
        return (
            launch("order_bounds", self.flags, (ALL_BINS,), **poses, **bins, particles=count),
            launch("order_count", self.flags, (count,), **poses, **bins, bin_of=self.bin_of, particles=count),
            launch("order_starts", self.flags, (ALL_BINS // STRETCH,), **bins),
            launch(
                "order_fill", self.flags, (count,), bin_of=self.bin_of, bins=self.bins, order=self.order,
                particles=count,
            ),
        )  # fmt: skip


def order_of(space: Workspace, placed: PlacedPoses, rays: int, real: np.dtype) -> Order | None:
    """Return an order of the particles where sorting pays, and upload its bounds."""
    count = placed.count
    if placed.inside is not None or count * rays < LEAST_ORDERED[0] or count < LEAST_ORDERED[1]:
        return None
    return Order(
        placed, space.upload("bounds", _UNBOUNDED), space.empty("bins", ALL_BINS, _INT),
        space.empty("bin_of", count, _INT), space.empty("order", count, _INT),
        flags_if(FLOAT64=real == np.float64),
    )  # fmt: skip


def spread_of(items: int, groups: int, enough: int) -> int:
    """Return log2 of the number of parts into which each of ``items`` work-items is split."""
    spread = 0
    while items << spread < enough and 1 << spread < groups:
        spread += 1
    return spread


def stranded(rays: int, spread: int) -> bool:
    """Return whether a launch in tiles has a block of rays for each group of a tile: work-items then sum strands."""
    return -(-rays // BLOCK_TERMS) >= 1 << spread


def tiles_of(particles: int, rays: int) -> tuple[int, int]:
    """Return the work-items of a launch in tiles of particles and rays, and its spread."""
    tiles = -(-particles // TILE_PARTICLES)
    spread = spread_of(tiles * TILE, -(-rays // TILE_RAYS), ENOUGH)
    return (tiles << spread) * TILE, spread


class Parts(NamedTuple):
    """Numbers that a particle's sum adds."""

    # Numbers of each particle.
    count: int  # type: ignore[assignment]  # hides tuple.count
    block: int  # 1 for sums of blocks or strands, BLOCK_TERMS for terms of single readings
    buffer: Buffer = None  # all of them, the numbers of a place ``particles`` apart


def sum_launch(flags: frozenset[str], particles: int, parts: Parts, **arguments: Any) -> Launch:
    """Return the launch that sums the parts of each particle (``arguments``: the other arguments of ``sum_parts``)."""
    return launch(
        "sum_parts", flags, (particles,), parts=parts.buffer, particles=particles, count=parts.count,
        block=parts.block, **arguments,
    )  # fmt: skip
