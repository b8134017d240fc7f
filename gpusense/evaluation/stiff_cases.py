"""The catalogue of extreme scenes: no beams, walls everywhere, maps far from the origin."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gpusense._util.typing import Reals
from gpusense.models.scan.caster import RayCaster
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Scanner


@dataclass(frozen=True)
class Case:
    """A scene that is extreme in one respect.

    Attributes:
        local: (N, 3) poses in the grid's frame [cells, cells, rad].
        beams: Beams of a scanner with a field of view of 360 degrees.
        readings: Readings that a scan repeats [cells]; None for the first pose's expected ranges, with missing and max
            readings.
        options: Arguments of the models, such as ``outside``.
        weights: Weights z_hit, z_short, z_max and z_rand.
        sigma: Standard deviation [cells].
        constant: log p if all particles have the same value; else None.
    """

    name: str
    grid: OccupancyGrid
    local: Reals
    beams: int = 41
    readings: tuple[float, ...] | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    weights: tuple[float, float, float, float] = (0.5, 0.125, 0.125, 0.25)
    sigma: float = 0.25
    constant: float | None = None

    @property
    def scanner(self) -> Scanner:
        """Return the scanner; its range of 20 cells ends at walls on the map, and not always off the map."""
        return Scanner(np.linspace(-math.pi, math.pi, self.beams, endpoint=False), 20 * self.grid.resolution)

    @property
    def poses(self) -> Reals:
        """Return (N, 3) poses in the world [m, m, rad]."""
        x, y, yaw = self.grid.origin
        (u, v), c, s = (self.local[:, :2] * self.grid.resolution).T, math.cos(yaw), math.sin(yaw)
        return np.stack([x + (c * u - s * v), y + (s * u + c * v), self.local[:, 2] + yaw], axis=1)

    @property
    def ranges(self) -> Reals:
        """Return (K,) readings [m]."""
        if self.readings is not None:
            return np.asarray(np.resize(self.readings, self.beams) * self.grid.resolution)
        far, bearings = self.scanner.range_max, self.scanner.bearings
        caster = RayCaster(self.grid, far, backend="numpy", precision="float64", **self.options)
        z = np.resize(caster.cast(self.poses[:1], bearings), self.beams)
        z[3::13], z[4::17], z[5::19], z[6::23] = np.nan, np.inf, 0.0, np.nextafter(far, 0)
        return z


def cases() -> Iterator[Case]:
    """Yield the catalogue of scenes."""
    random = np.random.default_rng(0)
    inside = random.uniform((1.5, 1.5, -4), (14.5, 10.5, 4), (40, 3))
    around = random.uniform((-8, -8, -4), (24, 20, 4), (40, 3))
    corners = np.array([(x, y, k * math.pi / 4) for x in (2, 7, 13) for y in (2, 5, 9) for k in range(-4, 5)], float)
    cells = np.pad(np.zeros((10, 14), np.int8), 1, constant_values=100)
    room, pillar, free = OccupancyGrid(cells, 0.25), cells.copy(), OccupancyGrid(0 * cells, 0.25)
    pillar[5:7, 7:9] = 100
    scene, unknown = OccupancyGrid(pillar, 0.25), OccupancyGrid(0 * cells - 1, 0.25)
    yield Case("no beams", scene, inside, beams=0, constant=0.0)
    yield Case("one beam", scene, inside, beams=1)
    yield Case("100 000 beams", scene, inside[:1], beams=100_000)
    yield Case("no particles", scene, inside[:0])
    yield Case("20 000 particles", scene, np.resize(inside, (20_000, 3)), beams=3)
    for rows, cols in ((1, 1), (1, 9), (9, 1), (12, 16)):
        yield Case(f"{rows} x {cols}, empty", OccupancyGrid(np.zeros((rows, cols), int), 0.25), around)
        yield Case(f"{rows} x {cols}, full", OccupancyGrid(np.full((rows, cols), 100), 0.25), around)
    yield Case("all unknown, free", unknown, around, options={"unknown": "free"})
    yield Case("all unknown, occupied", unknown, around, options={"unknown": "occupied"})
    yield Case("walls outside", free, around, options={"outside": "occupied"})
    yield Case("cells of 1 mm", OccupancyGrid(cells, 1e-3), inside)
    yield Case("cells of 100 m", OccupancyGrid(cells, 100.0), inside)
    yield Case("edges and corners, axes and 45 degrees", room, corners, beams=8)
    yield Case("in walls, on corners, off the map", scene, np.concatenate([np.round(around), around]), beams=16)
    yield Case("origin at 5e6 m, turned", OccupancyGrid(cells, 0.25, (5e6, -5e6, 1.0)), inside)
    yield Case("theta of 1e6 rad", room, inside + np.array([0, 0, 1e6]))
    yield Case("scan all NaN", scene, inside, readings=(math.nan,), constant=0.0)
    yield Case("scan all max", scene, inside, readings=(math.inf,), constant=41 * math.log(0.125))
    yield Case("scan all equal", scene, inside, readings=(3.0,))
    yield Case("log p of -1e9", scene, inside, readings=(2.5, 9.3), weights=(1.0, 0.0, 0.0, 0.0), sigma=1e-4)
    yield Case("impossible", scene, inside, readings=(19.5,), weights=(0.0, 1.0, 0.0, 0.0), constant=-math.inf)
