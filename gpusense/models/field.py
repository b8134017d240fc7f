"""The likelihood field, *Probabilistic Robotics* section 6.4: one look-up at each beam's end point."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from gpusense import _checks
from gpusense import compat as compat_module
from gpusense.backends import Backend
from gpusense.backends.base import Buffer
from gpusense.frames import split
from gpusense.grid import OccupancyGrid
from gpusense.lanes import widened
from gpusense.models.reachable import ReachableMap
from gpusense.models.scan_model import (
    HIGH_PEAK,
    ScanModel,
    check_poses,
    log_weight,
    place_in,
    rounded_terms,
    sums_linearly,
)
from gpusense.parameters import LikelihoodFieldParameters
from gpusense.plan import Omission, scene_omissions
from gpusense.prepare import check_size, squared_distances
from gpusense.scan import Beams, PreparedScan
from gpusense.scanner import Scanner

_RING = 2
# Longest table from squared distances to densities; a larger cap is looked up on the host while preparing.
_LONGEST_TABLE = 1 << 22


class LikelihoodFieldModel(ScanModel):
    """log p(z | x, m) of a scan by the distance of its end points to the nearest obstacle.

    Per hit ``z_hit N(d; 0, sigma_hit) + z_rand / range_max``; d is capped at ``max_distance``, which is also its value
    outside the grid. Max readings add ``log z_max`` where z_max > 0 and are left out otherwise (book table 6.3).

    Args:
        grid: The map.
        scanner: The scanner's geometry.
        parameters: Weights, deviation, cap and interpolation.
        backend: Where it runs; see ``gpusense.devices()``.
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
        backend: str | Backend = "auto",
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
        self._flags, self._terms = self._mixture()
        reach = (scanner.range_max + p.max_distance) / grid.resolution
        self._map = ReachableMap(
            self._backend, grid, self.unknown, scanner.mount, reach, self._prepare_table, crop=specialize
        )

    @property
    def table_bytes(self) -> int:
        """Bytes of the map's table on the device; 0 before the first call."""
        region = self._map.region
        return 0 if region is None else self._real.itemsize * (region.rows + 2 * _RING) * (region.cols + 2 * _RING)

    def prepare(self, poses: object) -> None:
        """Make the map's table for a cloud of (N, 3) poses now; ``log_likelihood`` does it otherwise.

        Raises:
            TypeError, ValueError: poses that are not (N, 3) finite numbers.
            MemoryError: the device cannot hold the table.
        """
        checked = check_poses(poses)
        if len(checked):
            with self._lock:
                self._map.ensure(checked)

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

    def _values(self, squared: np.ndarray) -> np.ndarray:
        """What the table holds for squared cell distances: log densities, or distances in metres. float64."""
        p = self.parameters
        distance = np.minimum(np.sqrt(squared) * self.grid.resolution, p.max_distance)
        if self._peer is not None:
            return self._cubes(distance)
        return self._log_density(distance) if self._log_table else distance

    def _cubes(self, distance: np.ndarray) -> np.ndarray:
        """What the peer sums: the cube of its density at a distance."""
        p, amcl = self.parameters, self.compat == "amcl"
        hit = p.z_hit if amcl else p.z_hit / (p.sigma_hit * math.sqrt(2 * math.pi))
        density = hit * np.exp(-0.5 * (distance / p.sigma_hit) ** 2) + p.z_rand / self.scanner.range_max
        return np.asarray(density**3)

    def _log_density(self, distance: np.ndarray) -> np.ndarray:
        p = self.parameters
        with np.errstate(over="ignore"):
            exponent = 0.5 * (distance / p.sigma_hit) ** 2
        log_hit = log_weight(p.z_hit) - math.log(p.sigma_hit) - 0.5 * math.log(2 * math.pi) - exponent
        return np.logaddexp(log_hit, log_weight(p.z_rand) - math.log(self.scanner.range_max))

    def _prepare_table(self, backend: Backend, obstacles: np.ndarray) -> Buffer:
        """Padded table of a window; its ring holds what lies outside the grid."""
        rows, cols = obstacles.shape
        check_size(rows, cols)
        p = self.parameters
        beyond = self._values(np.array([0.0 if self.outside == "occupied" else np.inf])).astype(self._real)
        if self.compat == "beluga" and self.outside == "free":
            beyond[:] = 1 / self.scanner.range_max**3
        size = (rows + 2 * _RING, cols + 2 * _RING)
        reach, diagonal = p.max_distance / self.grid.resolution, rows * rows + cols * cols
        farthest = diagonal if reach * reach >= diagonal else math.floor(reach * reach) + 1
        if self.outside == "occupied":
            return backend.upload(self._table_with_walls(obstacles, size))
        squared = squared_distances(backend, obstacles)
        if farthest > _LONGEST_TABLE:
            distances = backend.download(squared, np.empty((rows, cols), np.int32))
            table = np.full(size, beyond[0])
            table[_RING:-_RING, _RING:-_RING] = self._values(_with_infinity(distances))
            return backend.upload(table)
        density = self._values(np.append(np.arange(farthest + 1, dtype=np.float64), np.inf)).astype(self._real)
        table = backend.upload(np.full(size, beyond[0]))
        backend.compile("fill_field", self._flags)(
            (cols, rows), squared, backend.upload(density), table, rows, cols, farthest + 1
        )
        backend.synchronize()
        return table

    def _table_with_walls(self, obstacles: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        """Table of a window whose surroundings are occupied: distances see the ring as obstacles."""
        walled = np.pad(obstacles, _RING, constant_values=True)
        squared = self._backend.download(squared_distances(self._backend, walled), np.empty(size, np.int32))
        return self._values(_with_infinity(squared)).astype(self._real)

    def _impossible(self) -> bool:
        return self.parameters.z_hit == 0 and self.parameters.z_rand == 0

    def _prepare_launch(self, scan: PreparedScan) -> Callable[[np.ndarray, np.ndarray, bool], np.ndarray]:
        space, real = self._workspace, self._real
        cells = scan.readings / self.grid.resolution
        finite = np.isfinite(cells)
        high, low = split(scan.vectors * np.where(finite, cells, 0.0)[:, None], real)
        high[~finite] = cells[~finite, None]
        point, point_low = space.upload("point", high), space.upload("point_low", low)
        terms = space.upload("terms", self._terms)
        longest = np.max(cells, initial=0.0, where=finite)
        guard = 8 * np.finfo(real).eps * (longest + 2)
        readings = len(scan.readings)

        def launch(poses: np.ndarray, log_p: np.ndarray, per_beam: bool) -> np.ndarray:
            table, region = self._map.ensure(poses)
            placed, _ = place_in(region, poses, self.grid, self.scanner.mount, real)
            flags = self._flags | ({"PER_BEAM"} if per_beam else set())
            flags = self._last_code = widened(self._backend.info, "score_field", flags)
            count = len(poses)
            result = space.empty("log_p", count, real)
            parts = space.empty("parts", count * readings if per_beam else 1, real)
            careful = "CAREFUL" in flags
            self._backend.compile("score_field", flags)(
                (count,), table, space.upload("cell", placed.cell), space.upload("pose", placed.pose),
                space.upload("pose_low", placed.low if careful else placed.low[:1]), point, point_low, terms, result,
                parts, region.rows, region.cols, count, readings, guard, scan.constant + self._lead, self.temperature,
            )  # fmt: skip
            self._backend.download(result, log_p)
            each = np.empty((count, readings if per_beam else 0), real)
            return self._backend.download(parts, each) if per_beam else each

        return launch


def _with_infinity(squared: np.ndarray) -> np.ndarray:
    """Squared distances as float64, infinite where there is no obstacle."""
    return np.where(squared == np.iinfo(np.int32).max, np.inf, squared.astype(np.float64))
