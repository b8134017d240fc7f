"""The pipeline of scan models: request, readings, poses, program, run.

Every scan model and every kind of call passes through these five stages. A request holds checked arguments. Readings
and poses are brought to the device. The program follows from them and starts nothing. The file ``scoring`` runs it, in
the only loop, over pieces that fit the memory of the device.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterable, Iterator, MutableMapping
from typing import Any, NamedTuple

import numpy as np

from gpusense._util import checks
from gpusense.backends import arrays
from gpusense.backends.arrays import FLOATS, Result
from gpusense.backends.base import Buffer
from gpusense.backends.workspace import Workspace
from gpusense.interface.launches import Program
from gpusense.interface.structs import ScanBatch, Score
from gpusense.models.chunking import Piece, chunk_of
from gpusense.models.poses import Part, PlacedPoses, Poses, place
from gpusense.models.scan.classed import ClassedScans, ModelContext, check_ranges, class_scans
from gpusense.models.scan.readings import ReadingLayout, Readings, placing_launches
from gpusense.models.scan.tiles import Order, Parts, order_of
from gpusense.tables.reachable import MapState, ReachableMap
from gpusense.tables.world_index import WorldIndex
from gpusense.tables.worlds import Worlds
from gpusense.world.grid import OccupancyGrid
from gpusense.world.plausible import look_at_poses

# Poses that several models share, checked once, by the number of scans.
Known = MutableMapping[int | None, Poses]
# Rays times particles of one scan up to which several scans share their launches, by kind of device. Above, the
# launches of a single scan take longer on the device than their starts.
TOGETHER = {"gpu": 1 << 22, "cpu": 1 << 20}


class Request(NamedTuple):
    """S scans of N poses each."""

    ranges: np.ndarray  # (S, K) readings [m]
    poses: Poses  # the S N poses, one scan after the other
    shape: tuple[int, ...]  # shape of the result, (N,) or (S, N)
    result: Result  # memory of the result
    parts: np.ndarray  # (S, N, K) log-likelihoods of the readings; (S, N, 0) where they are not requested
    per_beam: bool  # true if they are requested, of a scanner with beams
    # Called once readings are on the device; it starts the launches that write the poses.
    before: Callable[[], None] | None = None
    own_scans: bool = False  # true if each of (N, 3) poses has a separate scan

    @property
    def scans(self) -> int:
        """S."""
        return len(self.ranges)

    @property
    def per_scan(self) -> int:
        """N."""
        return 1 if self.own_scans else self.shape[-1]

    def result_parts(self) -> np.ndarray:
        """Return the log-likelihoods of the readings, (N, K) or (S, N, K)."""
        return self.parts.reshape(*self.shape, self.parts.shape[-1])


def make_request(
    context: ModelContext,
    poses: Any,
    ranges: Any,
    out: Any = None,
    *,
    per_beam: bool = False,
    known: Known | None = None,
    before: Callable[[], None] | None = None,
    worlds: Worlds | None = None,
    world: Any = None,
    ignore: Any = None,
) -> Request:
    """Check the arguments of a call of (N, 3) or (S, N, 3) poses; ``known``: poses that were checked before.

    ``worlds``: the worlds of a model of worlds; ``world``, ``ignore``: see ``RayCaster.cast``.
    """
    backend, real, scanner = context.backend, context.real, context.rules.scanner
    if scanner._first_scans.left and isinstance(poses, (np.ndarray, list, tuple)):
        look_at_poses("poses", poses)
    beams = len(context.rules.columns)
    if type(ranges) is np.ndarray and ranges.shape == (beams,) and ranges.dtype in FLOATS:
        readings: np.ndarray = ranges
    else:
        readings = check_ranges(arrays.copied_to_host(ranges, backend, "ranges"), scanner)
    known = {} if known is None else known
    shape: tuple[int, ...]
    if worlds is not None:
        checked = Poses(poses, backend, late=True)
        if readings.ndim == 2 and len(readings) != checked.count:
            got = checks.shape_text(readings.shape)
            raise ValueError(f"ranges: shape must be ({beams},) or ({checked.count}, {beams}), got {got}")
        checked.inside = WorldIndex(worlds, world, ignore, checked.count, backend)
        own_scans, shape = readings.ndim == 2, (checked.count,)
        readings = readings if own_scans else readings[None]
        result = Result(poses, out, shape, real, backend, on_device=checked.on_device)
        parts = np.zeros((len(readings), 1 if own_scans else shape[0], beams if per_beam else 0), real)
        return Request(readings, checked, shape, result, parts, per_beam and beams > 0, before, own_scans)
    for name, value in (("world", world), ("ignore", ignore)):
        if value is not None:
            raise ValueError(f"{name}: must be None for a model of a single map, got {checks.show(value)}")
    if readings.ndim == 1:
        checked = known[None] = known.get(None) or Poses(poses, backend, late=True)
        readings, shape = readings[None], (checked.count,)
    else:
        scans = len(readings)
        checked = known[scans] = known.get(scans) or Poses(poses, backend, scans=scans, late=True)
        shape = (scans, checked.count // scans if scans else np.shape(poses)[1])
    result = Result(poses, out, shape, real, backend, on_device=checked.on_device)
    parts = np.zeros((len(readings), shape[-1], beams if per_beam else 0), real)
    return Request(readings, checked, shape, result, parts, per_beam and beams > 0, before)


class Tiles(NamedTuple):
    """A launch in tiles of particles and rays."""

    spread: int  # log2 of the number of groups of each tile
    order: Order | None  # the order of the particles, where sorting pays


class ScanLaunch(NamedTuple):
    """A piece of a request on the device, from which its program follows."""

    readings: Readings
    placed: PlacedPoses  # the poses
    table: Buffer  # the map's table for the window of the poses
    log_p: Buffer  # the buffer for the log-likelihoods
    flags: frozenset[str]  # flags of the scoring kernel
    tiles: Tiles | None  # the tiles of GPUs, which sum in a second launch; None if a single launch does everything
    per_beam: bool  # true if the log-likelihoods of single readings are kept

    @property
    def batch(self) -> ScanBatch:
        """Particles of each scan."""
        return ScanBatch(self.placed.count // self.readings.scans, 0)


class ScanPipeline(ABC):
    """The stages of one scan model."""

    # Rays of each beam, and numbers that GPUs keep for each reading until they are summed.
    rays_each: int = 1
    kept_parts: float = 1.0
    # Whether readings become end points, whether poses need low parts, and whether an order of particles may pay.
    end_points: bool = False
    careful: bool = False
    orders: bool = False
    # The kernels that score in one launch, and in tiles; without the latter GPUs score in one launch.
    kernel_names: tuple[tuple[str, ...], tuple[str, ...]]
    map: ReachableMap

    def __init__(self, context: ModelContext) -> None:
        self.context = context
        self.backend, self.real, self.rules = context.backend, context.real, context.rules
        self.scanner, self.specialize = context.rules.scanner, context.rules.specialize
        self._converted = context.weights.readings if context.weights.is_peer else None
        # Flags, keyed by everything on which they depend.
        self._flags: dict[Hashable, frozenset[str]] = {}
        # Largest launches, by rays and by whether the terms of readings are kept.
        self._most: dict[tuple[int, bool], int] = {}
        # Flags to add and to remove while omissions are measured.
        self.trial: tuple[frozenset[str], frozenset[str]] | None = None

    # ---- stages that depend on the model

    @property
    def grid(self) -> OccupancyGrid:
        """The current map."""
        return self.map.grid

    @abstractmethod
    def upload(self, scans: ClassedScans, space: Workspace) -> Readings:
        """Copy the readings of scans to the device."""

    @abstractmethod
    def sensing(self) -> ReadingLayout:
        """Return the rules for readings that are on the device."""

    @abstractmethod
    def place_arguments(self, filled: dict[str, Buffer]) -> dict[str, Buffer]:
        """Return the arguments of the scoring kernel from the buffers that ``place_inputs`` fills."""

    @abstractmethod
    def spread(self, particles: int, readings: Readings) -> int:
        """Return log2 of the number of parts into which the work of a tile is split."""

    @abstractmethod
    def conditions(self, readings: Readings, placed: PlacedPoses, tiles: Tiles | None) -> frozenset[str]:
        """Return the flags of the scoring kernel that depend on the poses and on their number."""

    @abstractmethod
    def flags(self, conditions: frozenset[str], *, tiled: bool, per_beam: bool) -> frozenset[str]:
        """Return the flags of the scoring kernel."""

    @abstractmethod
    def layout(self, readings: Readings, flags: frozenset[str]) -> tuple[int, int]:
        """Return the count of numbers that each particle's sum adds, and their block size; see ``Parts``."""

    def numbers(self, scoring: ScanLaunch) -> dict[str, Any]:
        """Return the arguments of the launches that change from call to call."""
        return dict(score=Score(scoring.readings.constant_term, self.context.temperature))

    @abstractmethod
    def score_launches(self, scoring: ScanLaunch) -> Program:
        """Return the launches of a piece whose poses are placed."""

    # ---- request: groups of scans that one program may score

    def groups(self, request: Request) -> Iterable[tuple[Piece, ClassedScans]]:
        """Return the particles and readings of neighbouring scans that one program may score."""
        if len(request.ranges) == 1:
            count, plain = request.shape[-1], self._converted is None
            scans = class_scans(request.ranges, self.rules) if plain else self.classed(request.ranges)
            return ((Piece(0, count, count), scans),)
        return self._groups_of_several(request)

    def _groups_of_several(self, request: Request) -> Iterator[tuple[Piece, ClassedScans]]:
        """Yield the groups of a request of several scans."""
        count = request.per_scan
        if self._shares_launches(request):
            scans = self.classed(request.ranges)
            for first, last in scans.groups():
                yield Piece(first * count, last * count, count), scans.part(first, last)
        else:
            for i in range(request.scans):
                yield Piece(i * count, (i + 1) * count, count), self.classed(request.ranges[i : i + 1])

    def _shares_launches(self, request: Request) -> bool:
        """Return whether several scans may be scored by one program."""
        if request.scans < 2 or request.per_beam or not self.context.possible:
            return False
        most = TOGETHER[self.backend.info.kind] // max(self.scanner.count * self.rays_each, 1)
        return request.per_scan <= min(most, self.most_particles(self.scanner.count, None))

    def most_particles(self, readings: int, inside: WorldIndex | None, *, per_beam: bool = False) -> int:
        """Return the largest number of particles of a launch, by its rays and the sights of poses in worlds."""
        rays = readings * self.rays_each + (0 if inside is None or self.end_points else inside.sights)
        most = self._most.get((rays, per_beam))
        if most is None:
            kept = 1.0 if per_beam else self.kept_parts if self.backend.info.kind == "gpu" else 0.0
            most = self._most[rays, per_beam] = chunk_of(self.backend, rays, self.real.itemsize * kept)
        return most

    # ---- readings

    def classed(self, ranges: np.ndarray) -> ClassedScans:
        """Class, choose and group the readings of (S, K) scans."""
        readings = ranges if self._converted is None else self._converted(ranges, self.scanner, self.end_points)
        return class_scans(readings, self.rules)

    def value(self, scans: ClassedScans) -> float | None:
        """Return the log-likelihood of scans if it is the same at every pose, else None."""
        if not len(scans.readings):
            context = self.context
            constant = context.weights.without_readings(scans.constants[0], context.constant_term, cubes=context.cubes)
            return float(context.temperature * constant)
        if not self.context.possible and np.isfinite(scans.readings).any():
            return -np.inf
        return None

    # ---- poses

    def place(self, poses: Poses, part: Part, space: Workspace) -> tuple[PlacedPoses, MapState]:
        """Place some poses in a window of the map; also return the map with its table."""
        corners = poses.corners(part, self.backend, space)
        state = self.map.ensure(corners)
        placed = place(
            poses, part, state.frame, self.backend, space, self.real, corners, careful=self.careful,
            sees=not self.end_points,
        )  # fmt: skip
        return placed, state

    # ---- program

    def scoring(
        self, readings: Readings, placed: PlacedPoses, table: Buffer, log_p: Buffer, space: Workspace, *,
        per_beam: bool = False, ordered: bool = True,
    ) -> ScanLaunch:  # fmt: skip
        """Describe a piece on the device."""
        tiles = None
        if self.backend.info.kind == "gpu" and self.kernel_names[1] and not per_beam:
            order = order_of(space, placed, readings.rays, self.real) if ordered and self.orders else None
            tiles = Tiles(self.spread(placed.count, readings), order)
        conditions = self.conditions(readings, placed, tiles)
        key = conditions, readings.flags, placed.flags, tiles is None, per_beam
        flags = self._flags.get(key)
        if flags is None:
            everything = conditions | readings.flags | placed.headings
            flags = self._flags[key] = self.flags(everything, tiled=tiles is not None, per_beam=per_beam)
        if self.trial is not None:
            flags = (flags | self.trial[0]) - self.trial[1]
        return ScanLaunch(readings, placed, table, log_p, flags, tiles, per_beam)

    def parts(self, scoring: ScanLaunch) -> Parts:
        """Return the numbers that each particle's sum adds, or the log-likelihoods of the readings."""
        count, block = self.layout(scoring.readings, scoring.flags)
        numbers = scoring.placed.count * count if scoring.tiles or scoring.per_beam else 1
        return Parts(count, block, scoring.placed.space.empty("parts", numbers, self.real))

    def program(self, scoring: ScanLaunch) -> Program:
        """Return all launches of a piece."""
        tiles = scoring.tiles
        order = () if tiles is None or tiles.order is None else tiles.order.launches()
        placing = placing_launches(scoring.placed, scoring.readings.placing)
        return (*placing, *order, *self.score_launches(scoring))
