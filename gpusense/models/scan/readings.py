"""Readings of scans on the device, as arguments of the scoring kernels."""

from __future__ import annotations

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
from gpusense.models.scan.rules import BeamChoice, Beams
from gpusense.world.range_causes import NoReturn
from gpusense.world.scanner import Scanner, range_limits

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

    scanner: Scanner  # the scanner's geometry
    beams: Beams  # the beams that are used
    vectors: np.ndarray = field(repr=False)  # (K, C, 2) float64 cosines and sines of the rays of each beam
    z_max: float  # probability of a max reading
    end_points: bool  # whether readings become end points
    max_depends: bool  # whether the probability of a max reading depends on the pose
    possible: bool  # true if some range is possible
    specialize: bool  # false leaves nothing out
    top: float  # largest range below a max reading
    guard_scale: float  # bound of the rounding errors of end points per cell of range
    real: np.dtype  # precision of the model

    @property
    def choice(self) -> BeamChoice:
        """The beams that are used."""
        return BeamChoice.of(self.beams, self.scanner.count)

    @property
    def columns(self) -> np.ndarray:
        """Beams whose readings are read."""
        return self.choice.columns

    @property
    def places(self) -> int:
        """Places of readings; those at the end may be missing (nan)."""
        return self.choice.most if self.specialize else len(self.choice.columns)

    @property
    def max_readings(self) -> int:
        """Treatment of max readings: left out, in the constant term, or in a place."""
        if self.z_max <= 0:
            return MAX_LEFT_OUT
        return MAX_PLACED if self.max_depends or not self.specialize else MAX_FIXED

    @property
    def constants_there(self) -> bool:
        """Return whether readings without a place may add a constant term."""
        return self.max_readings == MAX_FIXED or not self.possible


def device_readings(
    sensing: ReadingLayout, ranges: Buffer, dtype: np.dtype, limits: np.dtype, space: Workspace
) -> tuple[Placing, dict[str, Buffer]]:
    """Allocate places for readings that are on the device, and describe the launch that fills them.

    ``ranges``: (K,) readings.

    Returns:
        The launch, and the buffers that it fills by name.
    """
    real, places, columns = sensing.real, sensing.places, sensing.columns
    each, end_points = sensing.vectors.shape[1], sensing.end_points
    filled = dict(
        point=space.empty("point", 2 * places * each, real),
        point_low=space.empty("point_low", 2 * places if end_points else 2, real),
        reading=space.empty("reading", 1 if end_points else places, real),
        guard=space.empty("guard", -(-places // BLOCK_TERMS) if end_points else 1, real),
        constant_term=space.empty("constant_term", 1, real),
    )
    flags = flags_if(
        END_POINTS=end_points, FLOAT64=real == np.float64, ALL_READINGS=not sensing.specialize,
        RANGES_FLOAT32=dtype == np.float32, SOME_BEAMS=len(columns) < sensing.scanner.count,
    )  # fmt: skip
    nearest, farthest = range_limits(limits, sensing.scanner.range_min, sensing.scanner.range_max)
    chosen = sensing.choice.most
    kind = sensing.max_readings
    arguments = dict(
        filled, ranges=ranges, beam=space.upload("beam", columns.astype(_INT)),
        vector=space.upload("vector", sensing.vectors[columns]), head=-(-max(len(columns), 1) // _GROUP) * _GROUP,
        rules=ReadingRules(
            nearest, farthest, float(NoReturn(sensing.z_max).log_mass) if kind == MAX_FIXED else 0.0, sensing.top,
            sensing.guard_scale, len(columns), each, places, chosen, kind, int(sensing.possible),
        ),
    )  # fmt: skip
    return Placing(flags, arguments), filled


def device_scans(
    sensing: ReadingLayout, ranges: Buffer, dtype: np.dtype, scans: int, resolution: float, space: Workspace
) -> tuple[Launch, dict[str, Buffer]]:
    """Allocate places for a scan of each particle on the device, and return the launch that fills them.

    Every reading has a place; a missing one adds nothing.

    ``ranges``: (S, K) readings; ``resolution``: side of a cell [m].

    Returns:
        The launch, and the buffers that it fills by name.
    """
    real, columns, each = sensing.real, sensing.columns, sensing.vectors.shape[1]
    count, blocks, end_points = len(columns), -(-len(columns) // BLOCK_TERMS), sensing.end_points
    filled = dict(
        point=space.empty("point", 2 * scans * count * each, real),
        point_low=space.empty("point_low", 2 * scans * count if end_points else 2, real),
        reading=space.empty("reading", 1 if end_points else scans * count, real),
        guard=space.empty("guard", scans * blocks if end_points else 1, real),
    )
    flags = flags_if(END_POINTS=end_points, FLOAT64=real == np.float64, RANGES_FLOAT32=dtype == np.float32)
    nearest, farthest = range_limits(dtype, sensing.scanner.range_min, sensing.scanner.range_max)
    rules = ReadingRules(
        nearest, farthest, 0.0, sensing.top, sensing.guard_scale, count, each, count, count,
        MAX_LEFT_OUT if sensing.z_max <= 0 else MAX_PLACED, 1,
    )  # fmt: skip
    beam, vector = space.upload("beam", columns.astype(_INT)), space.upload("vector", sensing.vectors[columns])
    placing = launch(
        "place_scans", flags, (scans * count,), ranges=ranges, beam=beam, vector=vector, **filled, scans=scans,
        head=sensing.scanner.count, blocks=blocks, resolution=resolution, rules=rules,
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
