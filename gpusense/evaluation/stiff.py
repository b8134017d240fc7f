"""Evaluate a catalogue of stiff and extreme cases on a backend.

:func:`density_grid` evaluates the mixture of beam models on a grid of densities for which the textbook's formulas fail;
the truth is ``gpusense.models.scan.densities`` in float64, which tests compare with mpmath at 60 digits. The truth of
the scenes of :func:`cases` is evaluated in float64 on the device's rounded inputs and expected ranges.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util.typing import Precision, Reals
from gpusense.backends import Backend, Selection, get_backend
from gpusense.evaluation.replay import Launch, Recorder, replay
from gpusense.evaluation.tolerances import TOLERANCES, Check, Tolerance, beam_tolerance, per_scan
from gpusense.localization.weights import normalize_weights
from gpusense.models.scan.beam import BeamModel
from gpusense.models.scan.caster import RayCaster
from gpusense.models.scan.densities import log_mixture
from gpusense.models.scan.field import LikelihoodFieldModel
from gpusense.world.grid import OccupancyGrid
from gpusense.world.parameters import BeamParameters, LikelihoodFieldParameters
from gpusense.world.scanner import Scanner

# The density grid: range_max [m], in cells of 1 m; deviations over range_max; rates times range_max.
RANGE_MAX = 16.0
_DENSITIES = Tolerance("densities", 16, "eps (1 + |log p_k|) of the precision", "as for float32 beams")
_SCANS = Tolerance("stiff scans", 1, "of the scan's bound", "the bounds of the beams, and of their summation")
_WEIGHTS = Tolerance("sum of weights", 1e-6, "of 1", "normalised in float64; all are 0 where every pose is impossible")
SIGMAS = tuple(10.0**k for k in range(-8, 7))
RATES = (0.0, 1e-12, 1e-3, 1.0, 30.0, 1e3, 1e6)

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
class Densities:
    """The density grid as a device evaluated it: arrays of one length in the device's precision.

    Attributes:
        expected: Expected ranges, cast by the device [m].
        parameters: The fields of BeamParameters, by name.
    """

    z: Reals
    expected: Reals
    parameters: Mapping[str, Reals]
    log_p: Reals

    def truth(self) -> Reals:
        """Compute log p by the float64 densities on the same rounded numbers."""
        z, expected = self.z.astype(np.float64), self.expected.astype(np.float64)
        return np.asarray(log_mixture(z, expected, range_max=RANGE_MAX, **self.parameters))


def density_grid(backend: Selection, precision: Precision) -> Densities:
    """Evaluate the density grid by beam models of a scanner with equal beams.

    Eight particles face a wall from distances that are exact in cells: inside the wall, an ulp before it, and farther,
    to beyond range_max. Deviations and rates are rounded to the precision first, so that device and truth have the same
    inputs.
    """
    device, real = get_backend(backend), np.dtype(precision)
    ulp = float(np.spacing(real.type(RANGE_MAX / 2)))
    grid, poses = OccupancyGrid(100 * (np.arange(48)[None] < 1), 1.0), np.full((8, 3), (0.5, 0.5, math.pi))
    poses[1:, 0] += 0.5 + np.array([ulp / 8, 0.0009765625, 0.5, 2.2890625, 8.671875, RANGE_MAX - 2 * ulp, 19.5])
    # Warp compiles each set of flags for seconds, so its kernel is unspecialised and compiled once.
    options: dict[str, Any] = dict(precision=precision, specialize=device.info.backend != "warp")
    expected = RayCaster(grid, RANGE_MAX, backend=device, precision=precision).cast(poses, [0.0])[:, 0]
    blocks = []
    for p in _grid_parameters(real):
        z, recorder = _grid_readings(p, expected, ulp), Recorder(device)
        model = BeamModel(grid, Scanner(np.zeros(len(z)), RANGE_MAX), p, backend=recorder, **options)
        model.log_likelihood(poses, z, per_beam=True)
        for launch in recorder.launches:
            values = np.repeat(np.array([list(p.to_dict().values())], real).T, launch.parts.size, axis=1)
            blocks.append(np.vstack([*(part.ravel() for part in (*_inputs(launch), launch.parts)), values]))
    table = np.concatenate(blocks, axis=1).astype(real)
    return Densities(table[0], table[1], dict(zip(p.to_dict(), table[3:], strict=True)), table[2])


def _grid_parameters(real: np.dtype) -> Iterator[BeamParameters]:
    """Yield the mixtures of the density grid, with deviations and rates rounded to a precision."""
    for weights, sigmas, rates in _MIXTURES:
        for sigma, rate in itertools.product(sigmas, rates):
            yield BeamParameters(*weights, float(real.type(sigma * RANGE_MAX)), float(real.type(rate / RANGE_MAX)))


def _grid_readings(p: BeamParameters, expected: Reals, ulp: float) -> Reals:
    """Return readings at the expected ranges and where the mixture changes its shape [m]."""
    rate, sigma, peak = p.lambda_short, p.sigma_hit, float(expected[4])
    decay = 5 / rate if rate > 1 / RANGE_MAX else 0.9 * RANGE_MAX
    bends = [0.0, 0.3 * RANGE_MAX, decay, peak - 1.5 * sigma, peak + 6 * sigma, peak + 30 * sigma]
    return np.clip(np.concatenate([expected, bends]), 0, RANGE_MAX - ulp).astype(expected.dtype)


def error_in_eps(computed: ArrayLike, truth: ArrayLike, precision: str) -> Reals:
    """Return errors in eps (1 + |log p|) of a precision; infinite if only one side is infinite or a side is NaN."""
    a, b = np.asarray(computed, np.float64), np.asarray(truth, np.float64)
    with np.errstate(all="ignore"):
        error = np.abs(a - b) / (1 + np.abs(b)) / float(np.finfo(precision).eps)
    return np.where(a == b, 0.0, np.where(np.isfinite(a) & np.isfinite(b), error, np.inf))


@dataclass(frozen=True)
class Case:
    """A scene that is extreme in one respect.

    Attributes:
        local: (N, 3) poses in the grid's frame [cells, cells, rad].
        beams: Beams of a scanner with a field of view of 360 degrees.
        readings: Readings that a scan repeats [cells]; None for the first pose's expected ranges, with missing and max
            readings.
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


def _models(case: Case) -> Iterator[tuple[str, Callable[..., BeamModel | LikelihoodFieldModel], Any]]:
    (hit, _, top, _), cell = case.weights, case.grid.resolution
    yield "beam model", BeamModel, BeamParameters(*case.weights, case.sigma * cell, 1 / case.scanner.range_max)
    weights = (0.0, 1.0, 0.0) if case.constant == -math.inf else (hit, top, 1 - hit - top)
    nearest = LikelihoodFieldParameters(*weights, case.sigma * cell, 4 * cell)
    yield "field, nearest", LikelihoodFieldModel, nearest
    yield "field, bilinear", LikelihoodFieldModel, nearest.replace(interpolation="bilinear")


def case_checks(case: Case, device: Backend, precision: Precision) -> Iterator[Check]:
    """Compare the expected ranges of a scene with NumPy's, and the scores of all models with the truth."""
    scanner, poses, ranges = case.scanner, case.poses, case.ranges
    options: dict[str, Any] = {**case.options, "precision": precision}
    casters = (RayCaster(case.grid, scanner.range_max, backend=each, **options) for each in ("numpy", device))
    truth, cast = (caster.cast(poses, scanner.bearings) for caster in casters)
    exact, tolerance = TOLERANCES[f"{precision} ranges"], beam_tolerance(precision)

    def check(quantity: str, difference: float, allowed: Tolerance) -> Check:
        return Check(device.info.selection, "truth", f"{precision} {quantity}; {case.name}", difference, allowed)

    yield check("ranges", exact.difference(cast, truth), exact)
    for name, make, parameters in _models(case):
        recorder, specialize = Recorder(device), device.info.backend != "warp"
        model = make(case.grid, scanner, parameters, backend=recorder, specialize=specialize, **options)
        log_p, _ = model.log_likelihood(poses, ranges, per_beam=True)
        truth, fixed = np.empty((len(poses), 0)), case.constant or 0.0
        if recorder.launches:
            truth = np.concatenate([_truth(launch, parameters) for launch in recorder.launches])
            parts = np.concatenate([launch.parts for launch in recorder.launches])
            fixed = float(recorder.launches[0].values["score"].constant_term)
            yield check(f"{name}, beams", tolerance.difference(parts, truth), tolerance)
        total = truth.sum(axis=1) + fixed
        with np.errstate(all="ignore"):
            shares = np.abs(log_p - total) / per_scan(truth, precision, fixed=fixed)
        shares = np.where(log_p == total, 0.0, np.where(np.isnan(shares), np.inf, shares))
        yield check(f"{name}, scans", float(np.max(shares, initial=0.0)), _SCANS)
        if len(log_p):
            result = normalize_weights(log_p)
            consistent = result.degenerate == (case.constant == -math.inf) and np.isfinite(result.weights).all()
            yield check(f"{name}, weights", abs(float(result.weights.sum()) - 1) if consistent else math.inf, _WEIGHTS)


def _inputs(launch: Launch) -> tuple[Reals, Reals]:
    """Return the readings and expected ranges (particles, readings) of a launch of a beam model."""
    expected, first = launch.expected, launch.values["first"]
    assert expected is not None
    expected = expected if first is None else np.repeat(expected, np.diff(first), axis=1)
    return np.broadcast_to(launch.values["reading"], expected.shape), expected


def _truth(launch: Launch, parameters: Any) -> Reals:
    """Compute log p of a launch's beams in float64, on its rounded readings and expected ranges."""
    if launch.expected is None:
        return replay(launch)[1]
    (z, expected), top = (one.astype(np.float64) for one in _inputs(launch)), float(launch.values["scale"].range_max)
    # A reading below range_max may round to range_max in the launch's precision, and is still a hit.
    z = np.where(z == top, np.nextafter(top, 0), z)
    return np.where(np.isnan(z), 0.0, log_mixture(z, expected, range_max=top, **parameters.to_dict()))


def run(backend: Selection, precision: Precision) -> list[Check]:
    """Run the whole catalogue on a backend in a precision."""
    device, grid = get_backend(backend), density_grid(backend, precision)
    quantity, worst = f"{precision} densities; grid of {len(grid.z)}", error_in_eps(grid.log_p, grid.truth(), precision)
    listed = [Check(device.info.selection, "truth", quantity, float(worst.max()), _DENSITIES)]
    return listed + [check for case in cases() for check in case_checks(case, device, precision)]
