"""Readings that a beam model draws: ranges are cast on the device, and a kernel replaces them by readings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from gpusense._util import checks
from gpusense.backends import arrays, get_backend
from gpusense.backends.base import Backend, Buffer
from gpusense.backends.workspace import Workspace
from gpusense.interface import constants as c
from gpusense.interface.flags import flags_if
from gpusense.interface.launches import Launch, launch
from gpusense.interface.structs import MixtureTables, RangeScale
from gpusense.models.poses import Poses
from gpusense.models.scan.mixture import BeamDensity
from gpusense.world.hit_shapes import HitShape, shape_of
from gpusense.world.hit_tables import mass_table, quantile_table
from gpusense.world.parameters import BeamParameters
from gpusense.world.range_causes import ShortDensity
from gpusense.world.sensor_parameters import SensorTable

# Seeds are keys of Philox: two words of 32 bits.
MOST_SEED, MOST_STEP = (1 << 64) - 1, (1 << 31) - 1


@dataclass(frozen=True)
class Drawing:
    """The numbers from which readings are drawn."""

    mixture: np.ndarray  # numbers of the mixture for each bin of angles of incidence, then the tables of the hit shape
    edges: np.ndarray  # cosines between these bins, in the model's precision
    chances: np.ndarray  # cumulative probabilities of a table of a sensor; one number without a table
    cells: int  # number of range bins of the table; 0 without one
    range_max: float  # longest range [m]
    real: np.dtype  # precision of ranges and readings
    seed: int
    step: int  # step of the first scan
    per_scan: int  # particles of each scan
    shape_flags: frozenset[str] = frozenset()  # flags of the shape of hits

    @property
    def bins(self) -> int:
        """Bins of angles of incidence."""
        return len(self.edges)

    @property
    def flags(self) -> frozenset[str]:
        """The flags of the kernel."""
        flags = flags_if(FLOAT64=self.real == np.float64, SENSOR_TABLE=self.cells, INCIDENCE=self.bins > 1)
        return flags | self.shape_flags

    @property
    def tables(self) -> MixtureTables:
        """The sizes of the tables."""
        return MixtureTables(self.bins, self.cells, self.cells / self.range_max)

    def settings(self, first: int) -> np.ndarray:
        """Return the kernel's settings for particles from index ``first`` on."""
        settings = np.zeros(c.DRAW_SETTINGS)
        settings[c.DRAW_SEED : c.DRAW_SEED + 2] = self.seed & 0xFFFFFFFF, self.seed >> 32
        settings[c.DRAW_STEP], settings[c.DRAW_FIRST], settings[c.DRAW_PER_SCAN] = self.step, first, self.per_scan
        limit = self.real.type(self.range_max)
        settings[c.DRAW_RANGE_MAX], settings[c.DRAW_TOP] = self.range_max, np.nextafter(limit, self.real.type(0))
        # Rounding must not move a reading to the next bin.
        settings[c.DRAW_MARGIN] = 4 * max(self.cells, 1) * float(np.finfo(self.real).eps)
        return settings

    def launch(self, space: Workspace, first: int, count: int, rays: int, ranges: Buffer, incidence: Buffer) -> Launch:
        """Return the launch that replaces ranges by readings."""
        return launch(
            "draw_readings", self.flags, (rays, count), incidence=incidence,
            mixture=space.upload("draw_mixture", self.mixture), edges=space.upload("draw_edges", self.edges),
            chances=space.upload("draw_chances", self.chances),
            settings=space.upload("draw_settings", self.settings(first)), ranges=ranges, particles=count, rays=rays,
            tables=self.tables, scale=RangeScale(0.0, 0.0, self.range_max),
        )  # fmt: skip

    def on_host(self, first: int, count: int, rays: int, ranges: np.ndarray, incidence: np.ndarray) -> None:
        """Replace ranges by readings on the host."""
        get_backend("numpy").compile("draw_readings", self.flags)(
            (rays, count), incidence, self.mixture, self.edges, self.chances, self.settings(first), ranges, count, rays,
            self.tables, RangeScale(0.0, 0.0, self.range_max),
        )  # fmt: skip


def drawing_of(
    density: BeamDensity, range_max: float, real: np.dtype, *, seed: object, step: object, per_scan: int
) -> Drawing:
    """Return the numbers from which a model draws."""
    key = checks.integer("seed", seed, low=0, high=MOST_SEED)
    first = checks.integer("step", step, low=0, high=MOST_STEP)
    mixtures, table = density.mixtures, density.table
    chances, cells = (np.zeros(1), 0) if table is None else (chances_of(table), table.bins)
    return Drawing(
        mixture_numbers(mixtures), density.cosines.astype(real), chances, cells, range_max, real, key, first,
        max(per_scan, 1), shape_of(mixtures[0]).flags & {"MASS_TABLE"},
    )  # fmt: skip


def mixture_numbers(mixtures: tuple[BeamParameters, ...]) -> np.ndarray:
    """Return the mixtures' numbers as kernels take them, followed by the tables of their hit shapes."""
    names = (
        "z_hit", "z_short", "z_max", "z_rand", "sigma_hit", "sigma_growth", "range_bias",
    )  # fmt: skip
    numbers = np.array(
        [[*(getattr(p, name) for name in names), ShortDensity(p.lambda_short).rate, 0.0] for p in mixtures]
    )
    tables: dict[HitShape, np.ndarray] = {}
    begin = numbers.size
    for row, shape in zip(numbers, map(shape_of, mixtures), strict=True):
        if shape.tabulated and shape not in tables:
            tables[shape] = np.concatenate([mass_table(shape, np.dtype(np.float64)), quantile_table(shape)])
        row[-1] = begin + list(tables).index(shape) * len(tables[shape]) if shape.tabulated else 0.0
    return np.concatenate([numbers.ravel(), *tables.values()])


def chances_of(table: SensorTable) -> np.ndarray:
    """Return the cumulative probabilities of the bins of readings, for each bin of expected ranges."""
    log_p = np.array(table.sensor_table(np.float64))
    log_p[:-1] += np.log(table.range_max / table.bins)
    return np.ascontiguousarray(np.cumsum(np.exp(log_p), axis=0).T).ravel()


def poses_to_draw_at(poses: Any, backend: Backend) -> tuple[Poses, tuple[int, ...]]:
    """Return checked (N, 3) or (S, N, 3) poses, and their shape without the last axis."""
    if arrays.on_device(poses):
        shape = tuple(poses.shape)
        return Poses(poses, backend, scans=shape[0] if len(shape) == 3 else None), shape[:-1]
    read: Any = arrays.to_host(poses)
    if checks.as_array("poses", read).ndim == 3:
        several = checks.array("poses", read, ("S", "N", 3))
        return Poses(several.reshape(-1, 3), backend), several.shape[:-1]
    checked = Poses(read, backend)
    return checked, (checked.count,)
