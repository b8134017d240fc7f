"""The likelihood field, *Probabilistic Robotics* section 6.4: one look-up at each beam's end point."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from gpusense import _checks
from gpusense import compat as compat_module
from gpusense.backends import Selection
from gpusense.backends.base import Buffer
from gpusense.bound import PlacedScan, Scene, Scorer
from gpusense.cloud import ENOUGH_SHORT, Cloud, Placed, all_within, spread_of
from gpusense.frames import split
from gpusense.grid import OccupancyGrid
from gpusense.lanes import widened
from gpusense.models.field_table import RING, FieldTable
from gpusense.models.reachable import ReachableMap
from gpusense.models.scan_model import ScanModel
from gpusense.models.terms import HIGH_PEAK, log_weight, rounded_terms, sums_linearly
from gpusense.parameters import LikelihoodFieldParameters
from gpusense.plan import Omission, launch_omissions, scene_omissions
from gpusense.reference.error_free import BLOCK_TERMS
from gpusense.region import Region
from gpusense.scan import Beams, PreparedScan
from gpusense.scanner import Scanner

# The table's ring, and the particles of a work-group of ``field_blocks`` or of vectors: the kernel files ``field`` and
# ``lanes/field.cl`` have the same numbers.
_RING = 2
_GROUP = 64
# In eps and cells of a reading and 2 more: within this of a cell's edge an end point is found with more digits.
_GUARD = 3.25
_NO_FLAGS, _SCANS, _MISSING = frozenset[str](), frozenset({"SCANS"}), frozenset({"ALL_READINGS"})


class LikelihoodFieldModel(ScanModel):
    """log p(z | x, m) of a scan by the distance of its end points to the nearest obstacle.

    Per hit ``z_hit N(d; 0, sigma_hit) + z_rand / range_max``; d is capped at ``max_distance``, which is also its value
    outside the grid. Max readings add ``log z_max`` where z_max > 0 and are left out otherwise (book table 6.3).

    Args:
        grid: The map.
        scanner: The scanner's geometry.
        parameters: Weights, deviation, cap and interpolation.
        backend: Where it runs, see ``gpusense.devices()``; or a queue of pyopencl.
        precision: ``"float32"`` or ``"float64"``.
        unknown: Whether unknown cells are ``"free"`` (the default) or ``"occupied"``.
        outside: ``"free"`` (the default), or ``"occupied"`` for an obstacle at distance 0 everywhere outside the grid.
        temperature: In (0, 1]: multiplies the sum over beams. 1 is the book's plain product.
        beams: Use only so many informative beams, evenly chosen, or the beams of these indices.
        compat: None, or ``"amcl"`` or ``"beluga"`` for the weights that these programs compute, with their default
            parameters; see ``gpusense.compat``.
        specialize: False leaves nothing out: same numbers, slower.

    Raises:
        TypeError: an argument is of the wrong kind.
        ValueError: an argument breaks its rule, or the device is absent; the message names both.
    """

    def __init__(
        self,
        grid: OccupancyGrid,
        scanner: Scanner,
        parameters: LikelihoodFieldParameters | None = None,
        *,
        backend: Selection = "auto",
        precision: str = "float32",
        unknown: str | None = None,
        outside: str | None = None,
        temperature: float = 1.0,
        beams: Beams = None,
        compat: str | None = None,
        specialize: bool = True,
    ) -> None:
        peer = compat_module.choose(compat)
        default = LikelihoodFieldParameters() if peer is None else peer.field
        self.parameters = default if parameters is None else parameters
        if not isinstance(self.parameters, LikelihoodFieldParameters):
            raise TypeError(f"parameters: must be LikelihoodFieldParameters, got {_checks.show(parameters)}")
        compat_module.check_weights(self.parameters, compat)
        if peer is not None:
            _checks.choice("interpolation", self.parameters.interpolation, ("nearest",))
        super().__init__(
            grid, scanner, backend=backend, precision=precision, unknown=unknown, outside=outside,
            temperature=temperature, beams=beams, compat=compat, specialize=specialize, z_max=self.parameters.z_max,
            end_points=True,
        )  # fmt: skip
        p = self.parameters
        self._bilinear = p.interpolation == "bilinear"
        self._lead = 0.0 if peer is None else 1.0
        self._log_table = (specialize or peer is not None) and not self._bilinear
        self._guard = _GUARD * float(np.finfo(self._real).eps)
        self._firsts = np.arange(0, scanner.count, BLOCK_TERMS)
        self._flags, terms = self._mixture()
        self._quick, self._inside = self._flags | {"QUICK"}, self._flags | {"QUICK", "INSIDE"}
        self._terms_there = self._backend.upload(terms)
        self._none = self._backend.upload(np.zeros(1, np.int32))
        table = FieldTable(
            self._real, p, grid.resolution, scanner.range_max, outside=self.outside, compat=compat,
            log_table=self._log_table, flags=self._flags,
        )  # fmt: skip
        reach = (scanner.range_max + p.max_distance) / grid.resolution
        self._map = ReachableMap(
            self._backend, grid, self.unknown, scanner.mount, reach, table.make, specialize, table.mend
        )

    @property
    def table_bytes(self) -> int:
        """Bytes of the map's table on the device; 0 before the first call."""
        region = self._map.region
        return 0 if region is None else self._real.itemsize * (region.rows + 2 * RING) * (region.cols + 2 * RING)

    def prepare(self, poses: object) -> None:
        """Make the map's table for a cloud of (N, 3) poses now; ``log_likelihood`` does it otherwise.

        Raises:
            TypeError, ValueError: poses that are not (N, 3) finite numbers.
            MemoryError: the device cannot hold the table.
        """
        cloud = Cloud(poses, self._backend)
        if cloud.count:
            with self._lock:
                cloud.ensure(self._map, 0, cloud.count)

    def update_map(self, cells: object, region: object) -> None:
        """Replace cells of the map; afterwards every result is that of a model of the changed grid.

        Only distances that can have changed, those within ``max_distance`` of a changed obstacle, are computed again.

        Args:
            cells: (h, w) integers as ``OccupancyGrid.cells``: occupancy in per cent, or -1 for unknown.
            region: (row, col) of the cell that ``cells[0, 0]`` replaces.

        Raises:
            TypeError, ValueError: cells or a region that are not integers, or do not fit the grid; nothing has changed.
        """
        with self._lock:
            self.grid = self._map.update(cells, region)

    def explain(self) -> str:
        """What this scene does not need, why, and what leaving it out saves; readings and map as of the last call."""
        p = self.parameters
        components = [
            ("z_hit", p.z_hit, "1 exp per particle-beam"),
            ("z_rand", p.z_rand, "1 addition per particle-beam"),
            ("z_max", p.z_max, "max readings altogether"),
        ]
        omissions = scene_omissions(
            components=components, mount=self.scanner.mount, unknown=self.unknown, outside=self.outside,
            precision=self.precision,
        )  # fmt: skip
        if self._log_table:
            omissions.append(
                Omission("density per beam", "cells hold log densities (nearest)", "1 exp and 1 log per particle-beam")
            )
        if "SHARP" not in self._flags:
            low = f"the hit density's peak is at most {HIGH_PEAK:g} / m"
            why = low if self._bilinear else "no density is evaluated"
            omissions.append(Omission("exponents in two parts", why, "some 200 operations per particle-beam"))
        if not self._bilinear:
            omissions.append(Omission("interpolation", "interpolation='nearest'", "3 of 4 look-ups"))
        omissions += launch_omissions(self._last_code)
        if (far := self._map.omission(self._real.itemsize)) is not None:
            omissions.append(far)
        title = f"likelihood field{self._peer_note()}, {self.precision}, {self.device.selection} ({self.device.name})"
        return str(self._plan(title, omissions))

    def _mixture(self) -> tuple[frozenset[str], np.ndarray]:
        """Flags of the code, and the numbers of the kernel file ``field``."""
        p, range_max = self.parameters, self.scanner.range_max
        flags = self._scene_flags()
        flags |= {"BILINEAR"} if self._bilinear else set()
        flags |= {"LOG_TABLE"} if self._log_table else set()
        flags |= {"CAREFUL"} if self._real == np.float32 else set()
        flags |= {"CUBES"} if self._peer is not None else set()
        flags |= {"HIT"} if p.z_hit > 0 or not self._specialize else set()
        rand = p.z_rand / range_max
        scale = p.z_hit / (p.sigma_hit * math.sqrt(2 * math.pi))
        if not self._log_table and ((p.z_hit > 0 and scale > HIGH_PEAK) or not self._specialize):
            flags.add("SHARP")
        if sums_linearly(rand, scale, self._real):
            flags.add("LINEAR")
            head = (scale, rand)
        else:
            log_scale = log_weight(p.z_hit) - math.log(p.sigma_hit) - 0.5 * math.log(2 * math.pi)
            head = (log_scale, log_weight(p.z_rand) - math.log(range_max))
        terms = [head[0], 0.5 / p.sigma_hit / p.sigma_hit, head[1], log_weight(p.z_max)]
        return frozenset(flags), rounded_terms(terms, self._real)

    def _impossible(self) -> bool:
        return self.parameters.z_hit == 0 and self.parameters.z_rand == 0

    def _prepare_launch(self, scan: PreparedScan) -> Callable[[Cloud, tuple[int, int], Buffer, bool], Buffer]:
        space, real, backend = self._workspace, self._real, self._backend
        cells = scan.readings / self.grid.resolution
        lengths = cells
        if not self._specialize:
            # Missing and max readings are no lengths, and stay what they are as points.
            finite = np.isfinite(cells)
            lengths = np.where(finite, cells, 0.0)
        high, low = split(scan.vectors * lengths[:, None], real)
        if not self._specialize:
            high[~finite] = cells[~finite, None]
        longest = float(np.maximum.reduce(lengths))
        # What products of rounded factors and their sums can be off: 3.12 eps of the longest reading, and 1.5 eps.
        guard = self._guard * (longest + 2)
        readings, batch = scan.most_readings, scan.batch
        blocks = -(-readings // BLOCK_TERMS)
        numbers, start, counts = [high, low], self._none, self._none
        if backend.info.kind == "gpu":
            longest_each = self._longest_each(lengths, scan, blocks)
            numbers.append((self._guard * (longest_each + 2)).astype(real))
        if batch is None:
            given, fixed_of = space.upload_all("points", numbers), self._terms_there
        else:
            *given, fixed_of = space.upload_all("points", [*numbers, self._fixed_of(batch)])
            of_blocks = -(-batch.counts // BLOCK_TERMS)
            start, counts = space.upload_all("scans", (batch.start_readings, of_blocks.astype(np.int32)))
        point, point_low, guards = given if len(given) == 3 else (*given, None)
        scans = 1 if batch is None else len(batch.counts)

        careful = "CAREFUL" in self._flags
        quick = self._is_quick()
        scalars = (scan.constant + self._lead, self.temperature)
        reach = longest + 2

        def launch(cloud: Cloud, part: tuple[int, int], result: Buffer, per_beam: bool) -> Buffer:
            table, region, corners = cloud.ensure(self._map, *part)
            mount, count = self.scanner.mount, part[1] - part[0]
            poses = cloud.given(backend, space, part)
            flags, gpu = self._flags, backend.info.kind == "gpu" and not per_beam
            per_scan, several = count // scans, _NO_FLAGS if batch is None else _SCANS
            if gpu:
                if quick:
                    inside = all_within(corners, self.grid, mount, region, reach, _RING)
                    flags = self._inside if inside else self._quick
                flags |= several
                self._last_code = flags | cloud.headings()
                sizes = (count, readings, len(scan.readings), per_scan)
                if space.again((poses, result, table), cloud.code(), flags, self._map.preparations, sizes, scalars):
                    return None
            placed = cloud.place(backend, space, poses, part, (region, self.grid, mount), real, careful=careful)
            given = (table, placed.cell, placed.pose, placed.low, point, point_low, self._terms_there)
            if gpu:
                parts = space.empty("parts", count * blocks, real)
                spread = spread_of(count, blocks, ENOUGH_SHORT)
                backend.compile("field_blocks", flags)(
                    ((-(-count // _GROUP) << spread) * _GROUP,), *given, guards, start, parts, region.rows,
                    region.cols, count, readings, 1, count, spread, per_scan,
                )  # fmt: skip
                backend.compile("sum_parts", flags)(
                    (count,), parts, self._none, counts, fixed_of, result, count, blocks, 1, 1, count, *scalars,
                    per_scan,
                )  # fmt: skip
                space.keep()
                return parts
            flags |= several | cloud.headings() | ({"PER_BEAM"} if per_beam else set())
            flags = widened(backend.info, "score_field", flags)
            if quick and backend.info.vector_loops:
                flags |= {"QUICK"}
            self._last_code = flags
            parts = space.empty("parts", count * readings if per_beam else 1, real)
            # Vectors of particles hold those of one scan.
            size = scans * -(-per_scan // _GROUP) * _GROUP if "WIDE" in flags else count
            backend.compile("score_field", flags)(
                (size,), *given, start, fixed_of, result, parts, region.rows, region.cols, count, readings, guard,
                *scalars, per_scan, 0,
            )  # fmt: skip
            return parts

        return launch

    def _is_quick(self) -> bool:
        """Whether GPUs find cells by rounding, and again with more digits where that is in doubt."""
        return "CAREFUL" in self._flags and self._log_table and self._specialize

    def _longest_each(self, lengths: np.ndarray, scan: PreparedScan, blocks: int) -> np.ndarray:
        """The longest reading of each block, in cells; of several scans each has as many blocks as the longest."""
        if scan.batch is None:
            return np.maximum.reduceat(lengths, self._firsts[:blocks])
        counts = scan.batch.counts
        padded = np.zeros((len(counts), blocks * BLOCK_TERMS))
        padded[np.arange(padded.shape[1]) < counts[:, None]] = lengths
        return padded.reshape(len(counts), blocks, BLOCK_TERMS).max(axis=2)

    def _bound_scene(self) -> Scene:
        careful = "CAREFUL" in self._flags
        return Scene(self._map, self._vectors[:, None], guard_scale=self._guard, careful=careful)

    def _bound_parts(self, count: int, places: int) -> tuple[int, int]:
        return -(-places // BLOCK_TERMS), 1

    def _bound_scorer(self, table: Buffer, region: Region) -> Scorer:
        blocks = self._backend.compile("field_blocks", (self._quick if self._is_quick() else self._flags) | _MISSING)

        def score(placed: Placed, headings: frozenset[str], count: int, scan: PlacedScan, parts: Buffer) -> None:
            spread = spread_of(count, -(-scan.places // BLOCK_TERMS), ENOUGH_SHORT)
            blocks(
                ((-(-count // _GROUP) << spread) * _GROUP,), table, placed.cell, placed.pose, placed.low, scan.point,
                scan.low, self._terms_there, scan.guard, self._none, parts, region.rows, region.cols, count,
                scan.places, 1, count, spread, count,
            )  # fmt: skip

        return score
