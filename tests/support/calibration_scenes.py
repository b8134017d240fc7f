"""Simulation-based calibration: scenes of all models, readings drawn at poses of a prior, and ranks of these poses."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from gpusense._util.typing import Floats
from gpusense.backends import Selection
from gpusense.evaluation.buildings import building
from gpusense.evaluation.worlds import cloud_uniform
from gpusense.learning.discrete.probabilities import DiscreteCauses
from gpusense.learning.discrete.table import DiscreteBeamModel
from gpusense.models.landmark.lines import LineModel
from gpusense.models.landmark.model import LandmarkModel
from gpusense.models.point.absolute import HeadingModel, PositionModel
from gpusense.models.point.beacons import BeaconModel
from gpusense.models.point.bumper import BumperModel
from gpusense.models.scan.beam import BeamModel
from gpusense.tables.casters import Lookup
from gpusense.world.landmarks import LandmarkMap, LineMap
from gpusense.world.parameters import BeamParameters, IncidenceParameters, LandmarkParameters
from gpusense.world.scanner import Scanner
from gpusense.world.sensor_parameters import (
    BeaconParameters,
    BumperParameters,
    HeadingParameters,
    LineParameters,
    PositionParameters,
)


class Scene(NamedTuple):
    """A model that draws and scores readings, and the poses of a prior.

    Attributes:
        model: The model.
        poses: (N, 3) poses.
        draw: Returns a reading of each of some poses with a seed.
        score: Returns log p of a reading at poses.
    """

    model: Any
    poses: Floats
    draw: Draw
    score: Score


_GRID = building(seed=4, size=(12.0, 10.0), resolution=0.1)
# Wide densities leave several poses possible.
_WIDE = BeamParameters(
    z_hit=0.6, z_short=0.2, z_max=0.1, z_rand=0.1, sigma_hit=0.3, lambda_short=0.5, range_bias=0.1, sigma_growth=0.05
)
_LASER = Scanner(np.linspace(-2.0, 2.0, 4), range_max=5.0, mount=(0.1, 0.0, 0.2))
_SONAR = Scanner(np.linspace(-2.0, 2.0, 3), range_max=4.0, cone=0.3, cone_rays=3, critical_incidence=0.8)
_BY_INCIDENCE = IncidenceParameters(
    (0, 0.5, 1.0, math.pi / 2), (_WIDE, _WIDE.replace(sigma_hit=0.6), _WIDE.replace(z_hit=0.3, z_max=0.4)),
    _WIDE.replace(z_hit=0.1, z_max=0.6),
)  # fmt: skip
_TABLE = DiscreteBeamModel(DiscreteCauses(p_detect=0.4), range_max=5.0, bins=20)
_SCANS: dict[str, tuple[Scanner, Any, dict[str, Any]]] = {
    "beam": (_LASER, _WIDE, {}),
    "beam, coarse": (_LASER, _WIDE.replace(sigma_hit=4.0, z_max=0.0, z_rand=0.2), {}),
    "beam by incidence": (_LASER, None, dict(incidence=_BY_INCIDENCE)),
    "discrete": (_LASER, _TABLE, {}),
    "sonar": (_SONAR, _WIDE, {}),
    "beam, look-up": (_LASER, _WIDE, dict(caster=Lookup(bins=60))),
    "beam, marching": (_LASER, _WIDE, dict(caster="march")),
}
_MAP = LandmarkMap([(1.0, 1.0), (4.0, 2.0), (2.0, 4.0)], signatures=[1.0, 2.0, 3.0])
_PARTNERS = (0, 1, 2, -1)
_FEATURES = LandmarkParameters(
    sigma_range=0.8, sigma_bearing=0.9, sigma_signature=0.5, z_detect=0.7, z_false=0.3, range_max=8.0
)


def _scan(name: str, options: dict[str, Any]) -> Scene:
    scanner, parameters, more = _SCANS[name]
    model = BeamModel(_GRID, scanner, parameters, **more, **options)
    return Scene(model, cloud_uniform(_GRID, 8, np.random.default_rng(6)), model.sample, model.log_likelihood)


def _points(low: tuple[float, float, float], high: tuple[float, float, float]) -> Floats:
    return np.random.default_rng(5).uniform(low, high, (15, 3))


def _point(model: Any) -> Scene:
    over_map = isinstance(model, BumperModel)
    poses = _points((0.5, 0.5, -3.1), (11.5, 9.5, 3.1)) if over_map else _points((0, 0, -3.1), (5, 5, 3.1))
    return Scene(model, poses, model.sample, model.log_likelihood)


def _landmarks(narrow: bool, options: dict[str, Any]) -> Scene:
    poses, parameters = _points((-1.0, 0.0, -3.1), (5.0, 5.0, 3.1)), _FEATURES
    if narrow:
        # Poses that see all landmarks: an omitted reading beyond a limit would be information.
        parameters = parameters.replace(field_of_view=4.0, range_max=6.0)
        poses[:, :2] = _MAP.xy.mean(axis=0) + (-3.0, 0.0) + 0.3 * poses[:, :2]
        poses[:, 2] = -0.3 + 0.05 * poses[:, 2]
    model = LandmarkModel(_MAP, parameters, mount=(0.2, 0.1, 0.3), **options)

    def draw(at: Floats, seed: int) -> np.ndarray:
        return model.sample(at, seed, correspondence=_PARTNERS)

    def score(at: Floats, features: np.ndarray) -> np.ndarray:
        return model.log_likelihood(at, features, correspondence=_PARTNERS)

    return Scene(model, poses, draw, score)


def _lines(options: dict[str, Any]) -> Scene:
    # Long walls put the middle of the visible part at the foot of the normal: the ends carry no information.
    lines = LineMap([(99.0, 7.0, -99.0, 7.0), (7.0, -99.0, 7.0, 99.0), (-99.0, -30.0, 99.0, 30.0)], [False, True, True])
    p = LineParameters(sigma_angle=0.3, sigma_distance=0.8, z_detect=0.7, z_false=0.3, range_max=12.0)
    model = LineModel(lines, p, mount=(0.2, 0.1, 0.3), **options)
    partners = (0, 1, 2, -1)

    def draw(at: Floats, seed: int) -> np.ndarray:
        return model.sample(at, seed, correspondence=partners)

    def score(at: Floats, features: np.ndarray) -> np.ndarray:
        return model.log_likelihood(at, features, correspondence=partners)

    return Scene(model, _points((-1.0, 0.0, -3.1), (5.0, 5.0, 3.1)), draw, score)


def _beacons(kind: Any, options: dict[str, Any]) -> Scene:
    p = BeaconParameters(
        kind=kind, sigma_range=0.7, bias=(0.3, -0.2, 0.1), nu=3, range_max=9.0, mount=(0.2, 0.0)
    )  # fmt: skip
    return _point(BeaconModel(_MAP.xy, p, **options))


def _makers() -> Iterator[tuple[str, Callable[[dict[str, Any]], Scene]]]:
    for name in _SCANS:
        yield name, lambda options, name=name: _scan(name, options)  # type: ignore[misc]
    matrix, region = ((1.0, 0.6), (0.6, 2.0)), (-9.0, -9.0, 15.0, 15.0)
    fix = PositionParameters(covariance=matrix, z_hit=0.7, z_rand=0.3, region=region, mount=(0.5, 0.2))
    yield "position fix", lambda options: _point(PositionModel(fix, **options))
    headings = {
        "heading": HeadingParameters(sigma=0.8, z_hit=0.8, z_rand=0.2, offset=7.0),
        "heading, wide": HeadingParameters(sigma=2.0),
        "heading, von Mises": HeadingParameters(kind="von_mises", kappa=1.5),
    }
    for name, heading in headings.items():
        yield name, lambda options, p=heading: _point(HeadingModel(p, **options))  # type: ignore[misc]
    for kind in ("normal", "student_t", "mixture"):
        yield f"beacons, {kind}", lambda options, kind=kind: _beacons(kind, options)  # type: ignore[misc]
    bumper = BumperParameters(p_contact=0.8, p_false=0.2, sigma=0.3)
    segments = [(0.0, 2.0), (2.0, 4.0)]
    yield "bumper", lambda options: _point(BumperModel(_GRID, 0.3, bumper, segments=segments, **options))
    yield "landmarks", lambda options: _landmarks(False, options)
    yield "landmarks, narrow view", lambda options: _landmarks(True, options)
    yield "lines", _lines


MAKERS = dict(_makers())


def make_scene(name: str, backend: Selection = "numpy") -> Scene:
    """Return the scene of a name in MAKERS, with its model in float64."""
    return MAKERS[name](dict(backend=backend, precision="float64"))


Draw = Callable[[Floats, int], np.ndarray]
Score = Callable[[Floats, np.ndarray], np.ndarray]
FUNCTIONS = ("x", "y", "theta", "log p")
BINS = 10
# Each call may fail by chance with at most this probability; seeds are fixed.
FALSE_ALARM = 1e-4


def posterior_ranks(poses: Floats, draw: Draw, score: Score, runs: int, seed: int = 0) -> Floats:
    """Return (runs, 4) ranks of true poses by the functions of FUNCTIONS.

    Args:
        poses: (N, 3) poses of the prior.
        draw: Returns a reading of each of (M, 3) poses with a seed.
        score: Returns (N,) log p of one reading at poses.
        runs: Number of true poses.
        seed: Seed of the true poses and of the readings.
    """
    rng = np.random.default_rng(seed)
    true = rng.integers(len(poses), size=runs)
    readings = draw(poses[true], seed)
    ranks = np.empty((runs, len(FUNCTIONS)))
    for run, (index, reading) in enumerate(zip(true.tolist(), readings, strict=True)):
        log_p = np.asarray(score(poses, reading), np.float64)
        weight = np.exp(log_p - log_p.max())
        weight /= weight.sum()
        for column, value in enumerate((*poses.T, log_p)):
            below, same = weight[value < value[index]].sum(), weight[value == value[index]].sum()
            ranks[run, column] = below + rng.random() * same
    return ranks


def uniformity(ranks: Floats) -> dict[str, tuple[float, float]]:
    """Return the p-values of a chi-square test over ten bins, and of Kolmogorov and Smirnov's, by function."""
    from scipy import stats

    found = {}
    for name, column in zip(FUNCTIONS, ranks.T, strict=True):
        counts = np.histogram(column, BINS, (0, 1))[0]
        found[name] = (float(stats.chisquare(counts).pvalue), float(stats.kstest(column, "uniform").pvalue))
    return found


def assert_uniform(ranks: np.ndarray) -> None:
    """Check that ranks are uniform by two tests of four functions each, with a joint probability of a false alarm."""
    for name, p_values in uniformity(ranks).items():
        assert min(p_values) > FALSE_ALARM / 8, f"{name}: p = {p_values[0]:.2g} and {p_values[1]:.2g}"
