"""Evaluate a catalogue of stiff and extreme cases on a backend: each row is an error, its bound and a verdict.

:func:`density_grid` evaluates the mixture in the device's scoring kernel on a grid of densities for which the
textbook's formulas fail; the truth is ``gpusense.models.scan.densities`` in float64, which tests compare with mpmath at
60 digits. The truth of the scenes of :mod:`gpusense.evaluation.stiff_cases` is evaluated in float64 on the device's
rounded inputs and expected ranges.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util.typing import Reals
from gpusense.backends import Backend, Selection, get_backend
from gpusense.evaluation.replay import Launch, Recorder, replay
from gpusense.evaluation.stiff_cases import Case, cases
from gpusense.evaluation.tolerances import TOLERANCES, beam_tolerance, per_scan
from gpusense.interface import structs
from gpusense.interface.launches import launch
from gpusense.localization.weights import normalize_weights
from gpusense.models.scan.beam import BeamModel
from gpusense.models.scan.caster import RayCaster
from gpusense.models.scan.densities import log_mixture, naive_log_mixture
from gpusense.models.scan.field import LikelihoodFieldModel
from gpusense.tables.rectangles import Planes, empty_rectangles
from gpusense.world.grid import OccupancyGrid
from gpusense.world.parameters import BeamParameters, LikelihoodFieldParameters
from gpusense.world.scanner import Scanner

# The density grid: range_max [m], in cells of 1 m; deviations over range_max; rates times range_max; and the least
# share of the grid in which the textbook's formulas fail, below which the grid is not stiff.
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
    """Largest error of one quantity in one case, on one backend in one precision.

    Attributes:
        bound: Largest error allowed; for the textbook's formulas the least share of failures.
        nonfinite: Number of results that are NaN, or infinite where the truth is not.
        ok: Whether ``nonfinite`` is 0 and the bound is kept.
    """

    case: str
    quantity: str
    worst: float
    bound: float
    nonfinite: int
    ok: bool


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

    def naive(self) -> Reals:
        """Compute log p by the textbook's formulas in the grid's precision."""
        return np.asarray(naive_log_mixture(self.z, self.expected, range_max=RANGE_MAX, **self.parameters))


def density_grid(backend: Selection, precision: str) -> Densities:
    """Evaluate the density grid in the kernel ``score_beams``.

    The map is one row of cells with a wall. Eight particles face it from distances that are exact in cells: inside the
    wall, an ulp before it, and farther, to beyond range_max. Deviations and rates are rounded to the precision first,
    so that device and truth have the same inputs.
    """
    device, real, obstacles = get_backend(backend), np.dtype(precision), np.arange(48)[None] >= 40
    ulp = float(np.spacing(real.type(RANGE_MAX / 2)))
    poses = np.full((8, 4), (0.5, 0.5, 1.0, 0.0), real)
    poses[1:7, 0] = 1 - ulp / 16, 0.9990234375, 0.5, 0.7109375, 0.328125, ulp
    rectangles, count = empty_rectangles(device, obstacles, Planes(1)), len(poses)
    cells = device.upload(np.array([(c, 0) for c in (40, 39, 39, 39, 37, 31, 24, 20)], np.int32))
    pose, ray, ranges = device.upload(poses), device.upload(np.array([[1, 0]], real)), device.empty(count, real)
    wide = frozenset({"FLOAT64"} if real == np.float64 else ())
    casting = dict(
        map_table=rectangles, pose_cell=cells, pose=pose, ray=ray, window=structs.Window(0, 0, *obstacles.shape),
        particles=count, rays=1, caster=structs.Caster(0, 0.0, 0.0),
        scale=structs.RangeScale(RANGE_MAX, 1.0, RANGE_MAX),
    )  # fmt: skip
    device.run((launch("cast_ranges", wide, (1, count), **casting, ranges=ranges),))
    expected = device.download(ranges, np.empty(count, real))

    # Warp compiles each set of flags for seconds, so its kernel is unspecialised and compiled once.
    specialize = device.info.backend != "warp"
    flags = wide | {"PER_BEAM", "SHARED_RAYS"} | (set() if specialize else {"ALL_READINGS", "ORIGINS_OUTSIDE"})
    options: dict[str, Any] = dict(backend=device, precision=precision, specialize=specialize)
    scene = OccupancyGrid(obstacles.astype(np.int8)), Scanner([0.0], RANGE_MAX)
    blocks = []
    for p in _grid_parameters(real):
        model = BeamModel(*scene, p, **options)
        z = _grid_readings(p, expected, ulp)
        parts = device.empty(count * len(z), real)
        first = device.upload(np.array([0, len(z)], np.int32))
        mixture = model._beam_pipeline.mixture
        # Rays that are shared do not end behind a reading.
        scoring = launch(
            "score_beams", flags | (mixture.flags - {"STOPS"}), (count,), **casting, first=first,
            reading=device.upload(z), terms=device.upload(np.stack(mixture.terms, axis=1)),
            masses=device.upload(mixture.masses), log_p=device.empty(count, real), parts=parts, readings=len(z),
            tables=structs.MixtureTables(1, 0, 0.0), cone=structs.Cone(1, 0.0), score=structs.Score(0.0, 1.0),
        )  # fmt: skip
        device.run((scoring,))
        log_p = device.download(parts, np.empty(count * len(z), real))
        values = np.repeat(np.array([list(p.to_dict().values())], real).T, log_p.size, axis=1)
        blocks.append(np.vstack([np.tile(z, count), np.repeat(expected, len(z)), log_p, values]))
    table = np.concatenate(blocks, axis=1)
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


def _row(case: str, quantity: str, worst: float, bound: float, computed: ArrayLike, truth: ArrayLike) -> Row:
    a, b = np.asarray(computed), np.asarray(truth)
    lost = int(np.count_nonzero(np.isnan(a) | (np.isinf(a) & (a != b))))
    return Row(case, quantity, worst, bound, lost, worst <= bound and not lost)


def _grid_rows(backend: Backend, precision: str) -> Iterator[Row]:
    grid = density_grid(backend, precision)
    truth, naive, case = grid.truth(), grid.naive(), f"{len(grid.z)} densities"
    few = TOLERANCES["float32 beam"].value
    worst = float(error_in_eps(grid.log_p, truth, precision).max())
    yield _row(case, "beam model, eps (1 + |log p_k|)", worst, few, grid.log_p, truth)
    share = float(np.mean(error_in_eps(naive, truth, precision) > few))
    quantity = f"textbook formulas, share above {few:g} eps"
    yield replace(_row(case, quantity, share, NAIVE_LOSES, naive, truth), ok=share >= NAIVE_LOSES)


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
    truth, cast = (caster.cast(poses, scanner.bearings) for caster in casters)
    exact, tolerance = TOLERANCES[f"{precision} ranges"], beam_tolerance(precision)
    yield _row(case.name, f"ranges, {exact.unit}", exact.difference(cast, truth), exact.value, cast, truth)
    for name, make, parameters in _models(case):
        recorder, specialize = Recorder(device), device.info.backend != "warp"
        model = make(case.grid, scanner, parameters, backend=recorder, specialize=specialize, **options)
        log_p, _ = model.log_likelihood(poses, ranges, per_beam=True)
        truth, fixed = np.empty((len(poses), 0)), case.constant or 0.0
        if recorder.launches:
            truth = np.concatenate([_truth(launch, parameters) for launch in recorder.launches])
            parts = np.concatenate([launch.parts for launch in recorder.launches])
            fixed = float(recorder.launches[0].values["score"].constant_term)
            worst = tolerance.difference(parts, truth)
            yield _row(case.name, f"{name}, {tolerance.unit}", worst, tolerance.value, parts, truth)
        total = truth.sum(axis=1) + fixed
        with np.errstate(all="ignore"):
            shares = np.abs(log_p - total) / per_scan(truth, precision, fixed=fixed)
        share = float(np.max(np.where(log_p == total, 0.0, shares), initial=0.0))
        yield _row(case.name, f"{name}, scans, share of their bound", share, 1.0, log_p, total)
        if len(log_p):
            result = normalize_weights(log_p)
            consistent = result.degenerate == (case.constant == -math.inf)
            error = abs(float(result.weights.sum()) - 1) if consistent else math.inf
            yield _row(case.name, f"{name}, sum of the weights", error, 1e-6, result.weights, 0)


def _truth(launch: Launch, parameters: Any) -> Reals:
    """Compute log p of a launch's beams in float64, on its rounded readings and expected ranges."""
    if launch.expected is None:
        return replay(launch)[1]
    z, top = launch.values["reading"].astype(np.float64), float(launch.values["scale"].range_max)
    expected, first = launch.expected.astype(np.float64), launch.values["first"]
    if first is not None:
        expected = np.repeat(expected, np.diff(first), axis=1)
    # A reading below range_max may round to range_max in the launch's precision, and is still a hit.
    z = np.where(z == top, np.nextafter(top, 0), z)
    return np.where(np.isnan(z), 0.0, log_mixture(z, expected, range_max=top, **parameters.to_dict()))


def run(backend: Selection, precision: str) -> list[Row]:
    """Run the whole catalogue on a backend in a precision."""
    device = get_backend(backend)
    return [*_grid_rows(device, precision), *(row for case in cases() for row in _case_rows(case, device, precision))]
