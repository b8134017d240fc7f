"""Readings of scans on the device, as arguments of the scoring kernels."""

from __future__ import annotations

import math
from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from gpusense.backends.base import Buffer
from gpusense.backends.workspace import Workspace
from gpusense.interface.constants import BLOCK_TERMS, MAX_FIXED, MAX_LEFT_OUT, MAX_PLACED
from gpusense.interface.flags import flags_if
from gpusense.interface.launches import Launch, Program, launch
from gpusense.interface.structs import ReadingRules
from gpusense.models.poses import PlacedPoses
from gpusense.models.scan.classed import ModelContext
from gpusense.world.range_causes import NoReturn
from gpusense.world.scanner import range_limits

_INT = np.dtype(np.int32)
# The kernel places readings in whole groups of work-items, so that the work-items of poses begin a new group.
_GROUP = 64


class Readings(NamedTuple):
    """Readings of S scans on the device."""

    scans: int  # S
    rays: int  # largest number of rays of a scan
    readings: int  # largest number of readings of a scan
    flags: frozenset[str]  # flags of kernels that score them
    arguments: dict[str, Any]  # their arguments of scoring kernels, by name
    # Their arguments of ``sum_parts``, by name: counts of readings or blocks, and constant terms of scans. A single
    # scan of the host has none.
    sums: dict[str, Any]
    constant_term: float  # the constant term of a single scan
    key: Hashable = None  # all values on which the launches depend, except buffers
    reach: float = np.inf  # longest range in cells, and a bound of its error; infinite if unknown
    constants_there: bool = False  # true if a constant term of a single scan is in ``constant_terms`` on the device
    placing: Placing | None = None  # the launch that places them on the device; None where the host has placed them

    @property
    def constants(self) -> dict[str, Any]:
        """Their constant terms as an argument of scoring kernels, by name."""
        return {"constant_terms": self.sums["constant_terms"]} if self.sums else {}

    @property
    def sum_flags(self) -> frozenset[str]:
        """Flags of ``sum_parts``."""
        return flags_if(SCANS=self.constants_there)


@dataclass(frozen=True)
class Placing:
    """Readings that the kernel ``place_inputs`` places, along with poses; see the kernel file ``scan``."""

    flags: frozenset[str]  # flags of the kernel
    arguments: dict[str, Any]  # its arguments that are not those of ``place_poses``


@dataclass(frozen=True)
class ReadingLayout:
    """Rules for readings that are on the device."""

    context: ModelContext
    vectors: np.ndarray = field(repr=False)  # (K, C, 2) float64 cosines and sines of the rays of each beam
    end_points: bool  # whether readings become end points
    top: float = math.inf  # largest range below a max reading
    guard_scale: float = 0.0  # bound of the rounding errors of end points per cell of range

    @property
    def columns(self) -> np.ndarray:
        """Beams whose readings are read."""
        return self.context.rules.choice.columns

    @property
    def places(self) -> int:
        """Places of readings; those at the end may be missing (nan)."""
        return self.context.rules.choice.most if self.context.rules.specialize else len(self.columns)

    @property
    def max_readings(self) -> int:
        """Treatment of max readings: left out, in the constant term, or in a place."""
        rules = self.context.rules
        if rules.z_max <= 0:
            return MAX_LEFT_OUT
        return MAX_FIXED if rules.max_is_constant else MAX_PLACED

    @property
    def constants_there(self) -> bool:
        """Return whether readings without a place may add a constant term."""
        return self.max_readings == MAX_FIXED or not self.context.possible

    def numbers(self, places: int) -> int:
        """Return how many numbers the sum over a scan's places adds: blocks of end points, or single readings."""
        return -(-places // BLOCK_TERMS) if self.end_points else places

    def buffers(self, scans: int, places: int, space: Workspace) -> dict[str, Buffer]:
        """Allocate places for the readings of scans, by the arguments of the kernels that fill them."""
        real, count, blocks = self.context.real, scans * places, scans * -(-places // BLOCK_TERMS)
        return dict(
            point=space.empty("point", 2 * count * self.vectors.shape[1], real),
            point_low=space.empty("point_low", 2 * count if self.end_points else 2, real),
            reading=space.empty("reading", 1 if self.end_points else count, real),
            guard=space.empty("guard", blocks if self.end_points else 1, real),
        )

    def sources(self, space: Workspace) -> dict[str, Buffer]:
        """Upload the beams whose readings are read, and their rays, by the arguments of these kernels."""
        columns = self.columns
        beam, vector = space.upload("beam", columns.astype(_INT)), space.upload("vector", self.vectors[columns])
        return dict(beam=beam, vector=vector)

    def struct(self, limits: np.dtype, log_max: float, places: int, chosen: int, kind: int, able: int) -> ReadingRules:
        """Return the rules as these kernels take them; ``limits`` is the type to which the limits are rounded."""
        scanner = self.context.rules.scanner
        near_far = range_limits(limits, scanner.range_min, scanner.range_max)
        rest = len(self.columns), self.vectors.shape[1], places, chosen, kind, able
        return ReadingRules(*near_far, log_max, self.top, self.guard_scale, *rest)

    def flags(self, dtype: np.dtype) -> frozenset[str]:
        """Return the flags of these kernels for readings of a type."""
        return flags_if(
            END_POINTS=self.end_points, FLOAT64=self.context.real == np.float64, RANGES_FLOAT32=dtype == np.float32
        )


def device_readings(
    sensing: ReadingLayout, ranges: Buffer, dtype: np.dtype, limits: np.dtype, space: Workspace
) -> tuple[Placing, dict[str, Buffer]]:
    """Allocate places for (K,) readings on the device; return the launch that fills them, and these buffers by name."""
    columns, kind, rules = sensing.columns, sensing.max_readings, sensing.context.rules
    filled = sensing.buffers(1, sensing.places, space)
    filled["constant_term"] = space.empty("constant_term", 1, sensing.context.real)
    flags = sensing.flags(dtype) | flags_if(
        ALL_READINGS=not rules.specialize, SOME_BEAMS=len(columns) < rules.scanner.count
    )
    log_max = float(NoReturn(rules.z_max).log_mass) if kind == MAX_FIXED else 0.0
    arguments = dict(
        filled, ranges=ranges, **sensing.sources(space), head=-(-max(len(columns), 1) // _GROUP) * _GROUP,
        rules=sensing.struct(limits, log_max, sensing.places, rules.choice.most, kind, int(sensing.context.possible)),
    )  # fmt: skip
    return Placing(flags, arguments), filled


def device_scans(
    sensing: ReadingLayout, ranges: Buffer, dtype: np.dtype, scans: int, resolution: float, space: Workspace
) -> tuple[Launch, dict[str, Buffer]]:
    """Allocate places for (S, K) readings on the device, one scan a particle, and return the launch that fills them.

    Every reading has a place; a missing one adds nothing. ``resolution``: side of a cell [m].
    """
    rules, count = sensing.context.rules, len(sensing.columns)
    filled, kind = sensing.buffers(scans, count, space), MAX_LEFT_OUT if rules.z_max <= 0 else MAX_PLACED
    placing = launch(
        "place_scans", sensing.flags(dtype), (scans * count,), ranges=ranges, **sensing.sources(space), **filled,
        scans=scans, head=rules.scanner.count, blocks=-(-count // BLOCK_TERMS), resolution=resolution,
        rules=sensing.struct(dtype, 0.0, count, count, kind, 1),
    )  # fmt: skip
    return placing, filled


def placing_launches(placed: PlacedPoses, placing: Placing | None) -> Program:
    """Return the launch that places poses, and readings along with them."""
    if placing is None:
        return placed.launches()
    if placed.inside is not None:
        # A separate launch places poses in their worlds.
        head = placing.arguments["head"]
        given = placed._replace(inside=None).arguments() | {"particles": 0}
        readings = launch("place_inputs", placed.flags | placing.flags, (head,), **given, **placing.arguments)
        return (readings, *placed.launches())
    size = (placing.arguments["head"] + placed.count,)
    return (launch("place_inputs", placed.flags | placing.flags, size, **placed.arguments(), **placing.arguments),)
