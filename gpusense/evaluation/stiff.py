"""Stiff and extreme cases: a catalogue, and what a backend makes of it. Each row is an error, its bound and a verdict.

:func:`density_grid` evaluates the mixture in the device's own scoring kernel on a grid of densities that the textbook's
formulas do not survive; truth is ``gpusense.models.scan.densities`` in float64, which tests hold against 60 digits.
:func:`cases` are whole scenes: no beams, walls everywhere, maps far from the origin; truth is evaluated in float64 on
the device's own rounded inputs and expected ranges.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense.backends import Backend, Selection, get_backend
from gpusense.evaluation.replay import Launch, Recorder, replay
from gpusense.evaluation.tolerances import TOLERANCES, beam_tolerance, per_scan
from gpusense.localization.weights import normalize_weights
from gpusense.models.scan.beam import BeamModel
from gpusense.models.scan.caster import RayCaster
from gpusense.models.scan.densities import log_mixture, naive_log_mixture
from gpusense.models.scan.field import LikelihoodFieldModel
from gpusense.tables.rectangles import empty_rectangles
from gpusense.world.grid import OccupancyGrid
from gpusense.world.parameters import BeamParameters, LikelihoodFieldParameters
from gpusense.world.scanner import Scanner

Floats = NDArray[np.floating]

# The density grid: range_max [m], in cells of 1 m; deviations over range_max; rates times range_max; and the share of
# it in which the textbook's formulas must fail, or the grid is not stiff.
RANGE_MAX = 16.0
SIGMAS = tuple(10.0**k for k in range(-8, 7))
RATES = (0.0, 1e-12, 1e-3, 1.0, 30.0, 1e3, 1e6)
NAIVE_LOSES = 0.3

# (z_hit, z_short, z_max, z_rand), deviations and rates.
_MIXTURES: tuple[tuple[tuple[float, float, float, float], tuple[float, ...], tuple[float, ...]], ...] = (
    ((0.5, 0.125, 0.125, 0.25), SIGMAS, RATES),
    ((0.5, 0.5, 0.0, 0.0), SIGMAS, RATES),
    ((0.5, 0.25, 0.25, 2.0**-110), SIGMAS, (0.0, 1.0, 1e6)),
    ((1.0, 0.0, 0.0, 0.0), SIGMAS, (1.0,)),
    ((0.0, 1.0, 0.0, 0.0), (1.0,), RATES),
    ((0.0, 0.0, 0.0, 1.0), (1.0,), (1.0,)),
)


@dataclass(frozen=True)
class Row:
    """One case on one backend in one precision: the worst error of a quantity, in the unit that it names.

    ``nonfinite`` counts results that are NaN, or infinite where the truth is not; ``ok`` says that there are none and
    that the bound is kept. For the textbook's formulas the bound is the least share of failures.
    """

    case: str
    quantity: str
    worst: float
    bound: float
    nonfinite: int
    ok: bool


@dataclass(frozen=True)
class Densities:
    """The density grid as a device evaluated it, arrays of one length in its precision.

    Readings, expected ranges as the device cast them [m], the fields of BeamParameters, and the device's log p.
    """

    z: Floats
    expected: Floats
    parameters: Mapping[str, Floats]
    found: Floats

    def truth(self) -> Floats:
        """log p by the float64 densities on the same rounded numbers."""
        z, expected = self.z.astype(np.float64), self.expected.astype(np.float64)
        return np.asarray(log_mixture(z, expected, range_max=RANGE_MAX, **self.parameters))

    def naive(self) -> Floats:
        """log p by the textbook's formulas in the grid's precision."""
        return np.asarray(naive_log_mixture(self.z, self.expected, range_max=RANGE_MAX, **self.parameters))


def density_grid(backend: Selection, precision: str) -> Densities:
    """Evaluate the density grid in the kernel ``score_beams``.

    The world is one row of cells with a wall. Eight particles look at it along the row from distances that the cells
    hold exactly: inside the wall, an ulp before it, and so on up to beyond range_max. Deviations and rates are rounded
    to the precision first, so that a device is asked what the truth is asked.
    """
    device, real, obstacles = get_backend(backend), np.dtype(precision), np.arange(48)[None] >= 40
    ulp = float(np.spacing(real.type(RANGE_MAX / 2)))
    poses = np.full((8, 4), (0.5, 0.5, 1.0, 0.0), real)
    poses[1:7, 0] = 1 - ulp / 16, 0.9990234375, 0.5, 0.7109375, 0.328125, ulp
    rectangles, count = empty_rectangles(device, obstacles, 1), len(poses)
    cells = device.upload(np.array([(c, 0) for c in (40, 39, 39, 39, 37, 31, 24, 20)], np.int32))
    pose, ray, ranges = device.upload(poses), device.upload(np.array([[1, 0]], real)), device.empty(count, real)
    wide = frozenset({"FLOAT64"} if real == np.float64 else ())
    world, limits = (*obstacles.shape, count, 1), (RANGE_MAX, 1.0, RANGE_MAX)
    exact, none, laser = (0, 0.0, 0.0), device.empty(2, real), (1, 1, 0.0)
    device.compile("cast_ranges", wide)((1, count), rectangles, cells, pose, ray, ranges, *world, *exact, *limits)
    expected = device.download(ranges, np.empty(count, real))

    # Warp takes seconds for each set of flags, so there everything is compiled in, once.
    specialize = device.info.backend != "warp"
    flags = wide | {"PER_BEAM", "SHARED_RAYS"} | (set() if specialize else {"ALL_READINGS", "ORIGINS_OUTSIDE"})
    options: dict[str, Any] = dict(backend=device, precision=precision, specialize=specialize)
    scene = OccupancyGrid(obstacles.astype(np.int8)), Scanner([0.0], RANGE_MAX)
    blocks = []
    for weights, sigmas, rates in _MIXTURES:
        for shares in itertools.product(sigmas, rates):
            sigma, rate = float(real.type(shares[0] * RANGE_MAX)), float(real.type(shares[1] / RANGE_MAX))
            p = BeamParameters(*weights, sigma, rate)
            model = BeamModel(*scene, p, **options)
            decay, at = 5 / rate if rate > 1 / RANGE_MAX else 0.9 * RANGE_MAX, float(expected[4])
            bends = [0.0, 0.3 * RANGE_MAX, decay, at - 1.5 * sigma, at + 6 * sigma, at + 30 * sigma]
            z = np.clip(np.concatenate([expected, bends]), 0, RANGE_MAX - ulp).astype(real)
            parts = device.empty(count * len(z), real)
            first_there = device.upload(np.array([0, len(z)], np.int32))
            mixture = model._pipeline.mixture
            device.compile("score_beams", flags | mixture.flags)(
                (count,), rectangles, none, cells, pose, ray, first_there, device.upload(z),
                device.upload(mixture.terms), none, none, first_there, none, device.empty(count, real), parts, *world,
                len(z), *laser, *exact, 0, 0.0, *limits, 0.0, 1.0, 1, 0,
            )  # fmt: skip
            found = device.download(parts, np.empty(count * len(z), real))
            own = np.repeat(np.array([list(p.to_dict().values())], real).T, found.size, axis=1)
            blocks.append(np.vstack([np.tile(z, count), np.repeat(expected, len(z)), found, own]))
    table = np.concatenate(blocks, axis=1)
    return Densities(table[0], table[1], dict(zip(p.to_dict(), table[3:], strict=True)), table[2])


def error_in_eps(found: ArrayLike, truth: ArrayLike, precision: str) -> Floats:
    """Errors over eps (1 + |log p|), eps that of the precision; infinite where only one is infinite, or one is NaN."""
    a, b = np.asarray(found, np.float64), np.asarray(truth, np.float64)
    with np.errstate(all="ignore"):
        error = np.abs(a - b) / (1 + np.abs(b)) / float(np.finfo(precision).eps)
    return np.where(a == b, 0.0, np.where(np.isfinite(a) & np.isfinite(b), error, np.inf))


def _row(case: str, quantity: str, worst: float, bound: float, found: ArrayLike, truth: ArrayLike) -> Row:
    a, b = np.asarray(found), np.asarray(truth)
    lost = int(np.count_nonzero(np.isnan(a) | (np.isinf(a) & (a != b))))
    return Row(case, quantity, worst, bound, lost, worst <= bound and not lost)


def _grid_rows(backend: Backend, precision: str) -> Iterator[Row]:
    grid = density_grid(backend, precision)
    truth, naive, case = grid.truth(), grid.naive(), f"{len(grid.z)} densities"
    few = TOLERANCES["float32 beam"].value
    worst = float(error_in_eps(grid.found, truth, precision).max())
    yield _row(case, "beam model, eps (1 + |log p_k|)", worst, few, grid.found, truth)
    share = float(np.mean(error_in_eps(naive, truth, precision) > few))
    quantity = f"textbook formulas, share above {few:g} eps"
    yield replace(_row(case, quantity, share, NAIVE_LOSES, naive, truth), ok=share >= NAIVE_LOSES)


@dataclass(frozen=True)
class Case:
    """A scene that is extreme in one way.

    Attributes:
        name: In which.
        grid: The map.
        local: (N, 3) poses in the grid's frame [cells, cells, rad].
        beams: Beams of a scanner that looks all around.
        readings: What a scan repeats [cells]; None is what the first pose expects, with missing and max readings.
        options: Arguments of the models, such as ``outside``.
        weights: z_hit, z_short, z_max and z_rand.
        sigma: Standard deviation [cells].
        constant: log p where every particle has the same; else None.
    """

    name: str
    grid: OccupancyGrid
    local: Floats
    beams: int = 41
    readings: tuple[float, ...] | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    weights: tuple[float, float, float, float] = (0.5, 0.125, 0.125, 0.25)
    sigma: float = 0.25
    constant: float | None = None

    @property
    def scanner(self) -> Scanner:
        """20 cells far: some rays end at a wall, and some from off the map do not."""
        return Scanner(np.linspace(-math.pi, math.pi, self.beams, endpoint=False), 20 * self.grid.resolution)

    @property
    def poses(self) -> Floats:
        """(N, 3) in the world."""
        x, y, yaw = self.grid.origin
        (u, v), c, s = (self.local[:, :2] * self.grid.resolution).T, math.cos(yaw), math.sin(yaw)
        return np.stack([x + (c * u - s * v), y + (s * u + c * v), self.local[:, 2] + yaw], axis=1)

    @property
    def ranges(self) -> Floats:
        """(K,) readings [m]."""
        if self.readings is not None:
            return np.asarray(np.resize(self.readings, self.beams) * self.grid.resolution)
        far, bearings = self.scanner.range_max, self.scanner.bearings
        caster = RayCaster(self.grid, far, backend="numpy", precision="float64", **self.options)
        z = np.resize(caster.cast(self.poses[:1], bearings), self.beams)
        z[3::13], z[4::17], z[5::19], z[6::23] = np.nan, np.inf, 0.0, np.nextafter(far, 0)
        return z


def cases() -> Iterator[Case]:
    """The catalogue of scenes."""
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


def _models(case: Case) -> Iterator[tuple[str, Callable[..., BeamModel | LikelihoodFieldModel], Any]]:
    (hit, _, top, _), cell = case.weights, case.grid.resolution
    yield "beam model", BeamModel, BeamParameters(*case.weights, case.sigma * cell, 1 / case.scanner.range_max)
    weights = (0.0, 1.0, 0.0) if case.constant == -math.inf else (hit, top, 1 - hit - top)
    nearest = LikelihoodFieldParameters(*weights, case.sigma * cell, 4 * cell)
    yield "field, nearest", LikelihoodFieldModel, nearest
    yield "field, bilinear", LikelihoodFieldModel, nearest.replace(interpolation="bilinear")


def _case_rows(case: Case, device: Backend, precision: str) -> Iterator[Row]:
    scanner, poses, ranges = case.scanner, case.poses, case.ranges
    options: dict[str, Any] = {**case.options, "precision": precision}
    casters = (RayCaster(case.grid, scanner.range_max, backend=each, **options) for each in ("numpy", device))
    truth, found = (caster.cast(poses, scanner.bearings) for caster in casters)
    exact, tolerance = TOLERANCES[f"{precision} ranges"], beam_tolerance(precision)
    yield _row(case.name, f"ranges, {exact.unit}", exact.difference(found, truth), exact.value, found, truth)
    for name, make, parameters in _models(case):
        recorder, specialize = Recorder(device), device.info.backend != "warp"
        model = make(case.grid, scanner, parameters, backend=recorder, specialize=specialize, **options)
        log_p, _ = model.log_likelihood(poses, ranges, per_beam=True)
        truth, fixed = np.empty((len(poses), 0)), case.constant or 0.0
        if recorder.launches:
            truth = np.concatenate([_truth(launch, parameters) for launch in recorder.launches])
            parts = np.concatenate([launch.parts for launch in recorder.launches])
            fixed = float(recorder.launches[0].values["fixed"])
            worst = tolerance.difference(parts, truth)
            yield _row(case.name, f"{name}, {tolerance.unit}", worst, tolerance.value, parts, truth)
        total = truth.sum(axis=1) + fixed
        with np.errstate(all="ignore"):
            shares = np.abs(log_p - total) / per_scan(truth, precision, fixed=fixed)
        share = float(np.max(np.where(log_p == total, 0.0, shares), initial=0.0))
        yield _row(case.name, f"{name}, scans, share of their bound", share, 1.0, log_p, total)
        if len(log_p):
            made = normalize_weights(log_p)
            apart = abs(float(made.weights.sum()) - 1) if made.degenerate == (case.constant == -math.inf) else math.inf
            yield _row(case.name, f"{name}, sum of the weights", apart, 1e-6, made.weights, 0)


def _truth(launch: Launch, parameters: Any) -> Floats:
    """log p of a launch's beams in float64, on its own rounded readings and expected ranges."""
    if launch.expected is None:
        return replay(launch)[1]
    z, top = launch.values["reading"].astype(np.float64), float(launch.values["range_max"])
    expected = np.repeat(launch.expected.astype(np.float64), np.diff(launch.values["first"]), axis=1)
    # A reading below range_max may be rounded to it, and is still a hit.
    z = np.where(z == top, np.nextafter(top, 0), z)
    return np.where(np.isnan(z), 0.0, log_mixture(z, expected, range_max=top, **parameters.to_dict()))


def run(backend: Selection, precision: str) -> list[Row]:
    """Every row of the catalogue on a backend, in ``"float32"`` or ``"float64"``."""
    device = get_backend(backend)
    return [*_grid_rows(device, precision), *(row for case in cases() for row in _case_rows(case, device, precision))]
