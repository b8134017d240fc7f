"""How well a model ranks the true pose: scans of a log scored for clouds of particles, on one backend or several.

Per scan the particles are the logged pose, half of the rest around it, and the other half uniformly over the map's
free cells. The logged pose is ranked among them; it takes no part in the weighted mean, which it would pull to itself.
"""

from __future__ import annotations

import itertools
import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks
from gpusense.backends import BackendInfo
from gpusense.evaluation.tolerances import scan_tolerance
from gpusense.evaluation.worlds import cloud_around, cloud_uniform
from gpusense.localization.weights import normalize_weights
from gpusense.logs import Pose, Scan, read_log
from gpusense.models.scan.beam import BeamModel
from gpusense.models.scan.classed import choose_beams
from gpusense.models.scan.field import LikelihoodFieldModel
from gpusense.world.grid import OccupancyGrid
from gpusense.world.parameters import BeamParameters, LikelihoodFieldParameters
from gpusense.world.scanner import Reading, classify
from gpusense.world.sensor_table import SensorTable

Array = NDArray[Any]
Model = BeamModel | LikelihoodFieldModel
Floats = NDArray[np.float64]

# For a laser and a map of 5 cm: end points lie within a cell or two of a wall, but people, door frames and grazing
# incidence make one reading in five something else.
BEAM_PARAMETERS = BeamParameters(z_hit=0.75, z_short=0.1, z_max=0.05, z_rand=0.1, sigma_hit=0.1, lambda_short=0.2)
FIELD_PARAMETERS = LikelihoodFieldParameters(z_hit=0.9, z_max=0.0, z_rand=0.1, sigma_hit=0.1, max_distance=1.0)


@dataclass(frozen=True)
class Cloud:
    """How the particles of a scan are drawn.

    Attributes:
        particles: Their number, at least 2.
        sigma_position: Deviation of those around the logged pose, in x and in y, >= 0 [m].
        sigma_heading: Deviation of their heading, >= 0 [rad].
        seed: Seed; each scan draws from its own stream, so that a choice of scans changes nothing.
    """

    particles: int = 20_000
    sigma_position: float = 0.5
    sigma_heading: float = 0.25
    seed: int = 0

    def __post_init__(self) -> None:
        checks.integer("particles", self.particles, low=2)
        checks.integer("seed", self.seed, low=0)

    def draw(self, index: int, pose: Pose, grid: OccupancyGrid) -> Floats:
        """(N, 3) particles of the scan of that index: its pose, those around it, those all over the free cells."""
        random = np.random.default_rng((self.seed, index))
        near = (self.particles - 1) // 2
        around = cloud_around(pose, near, self.sigma_position, self.sigma_heading, random)
        return np.concatenate([[pose], around, cloud_uniform(grid, self.particles - 1 - near, random)])


@dataclass(frozen=True)
class ScanScore:
    """What one scan says on one backend.

    Attributes:
        index: The scan's number in its log, from 0.
        pose: Its logged pose.
        rank: Rank of the logged pose, 1 the best; the mean of the places that it shares with its equals.
        percentile: Share of the other particles that score worse, half of its equals included [%].
        mean: Weighted mean of the other particles, its heading by the circular mean; None where no weight is left.
        error_position: Distance of the mean from the logged pose [m], or None.
        error_heading: Difference of heading, 0 to pi [rad], or None.
        effective: Effective sample size of the other particles, or None.
        degenerate: Whether every other particle has probability 0.
        beams: Readings that were evaluated at every particle.
        seconds: Time of the call.
    """

    index: int
    pose: Pose
    rank: float
    percentile: float
    mean: Pose | None
    error_position: float | None
    error_heading: float | None
    effective: float | None
    degenerate: bool
    beams: int
    seconds: float


@dataclass(frozen=True)
class BackendScore:
    """All scans on one backend."""

    device: BackendInfo
    particles: int
    scans: tuple[ScanScore, ...]

    @property
    def particle_beams_per_second(self) -> float | None:
        """Evaluated readings per second; without the first scan, which compiles, where there is another."""
        steady = self.scans[1:] or self.scans
        seconds = sum(scan.seconds for scan in steady)
        return self.particles * sum(scan.beams for scan in steady) / seconds if seconds > 0 else None


@dataclass(frozen=True)
class Agreement:
    """How two backends rank the same particles, over all scans.

    Attributes:
        left, right: Selection strings of the two.
        scans: Number of scans compared.
        same_rank: In how many the logged pose has the same rank.
        same_order: In how many no two particles change places; particles that tie on one side may differ on the other.
        spearman: Smallest rank correlation of all particles.
        difference: Largest difference of log-likelihoods [nats].
        gap: Largest difference in log-likelihood between two particles that change places [nats].
        allowed: What rounding explains between these two [nats].
    """

    left: str
    right: str
    scans: int
    same_rank: int
    same_order: int
    spearman: float
    difference: float
    gap: float
    allowed: float

    @property
    def same(self) -> bool:
        """Whether the ranking is the same, but for particles closer to one another than rounding can tell."""
        return self.gap <= self.allowed


def score_scan(index: int, poses: Floats, log_p: Array, beams: int, seconds: float) -> ScanScore:
    """Judge the log-likelihoods of particles, of which the first is the logged pose."""
    better, equal = np.count_nonzero(log_p[1:] > log_p[0]), np.count_nonzero(log_p[1:] == log_p[0])
    others = len(log_p) - 1
    found = normalize_weights(log_p[1:])
    pose = cast(Pose, tuple(poses[0].tolist()))
    mean: Pose | None = None
    position = heading = effective = None
    if not found.degenerate:
        weights, effective = found.weights, found.effective_sample_size
        x, y = (weights @ poses[1:, :2]).tolist()
        theta = math.atan2(float(weights @ np.sin(poses[1:, 2])), float(weights @ np.cos(poses[1:, 2])))
        mean = (x, y, theta)
        position = math.hypot(x - pose[0], y - pose[1])
        heading = abs(math.remainder(theta - pose[2], math.tau))
    return ScanScore(
        index, pose, 1 + better + equal / 2, 100 * (others - better - equal / 2) / others, mean, position, heading,
        effective, found.degenerate, beams, seconds,
    )  # fmt: skip


def ranks(values: Array) -> Floats:
    """Ranks from the smallest value, equals sharing the mean of theirs."""
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(counts)
    return (last - (counts - 1) / 2)[inverse]


def correlation(left: Floats, right: Floats) -> float:
    """Pearson's correlation, of ranks Spearman's; where a side is constant, 1 if the other one is the same."""
    a, b = left - left.mean(), right - right.mean()
    size = math.sqrt(float(a @ a) * float(b @ b))
    return float(a @ b) / size if size else float(np.array_equal(left, right))


def largest_gap(left: Array, right: Array) -> float:
    """By how much, on the right, a particle beats one that the left puts before it."""
    order = np.lexsort((-right, -left))
    b = right[order].astype(np.float64)
    lowest = np.minimum.accumulate(b)
    with np.errstate(invalid="ignore"):
        return float(np.max(np.where(b == lowest, 0.0, b - lowest), initial=0.0))


class Comparison:
    """Compares the same model on two backends, scan by scan."""

    def __init__(self, left: Model, right: Model) -> None:
        self._models = left, right
        self._scans = self._same_rank = self._same_order = 0
        self._spearman, self._difference, self._gap, self._allowed = 1.0, 0.0, 0.0, 0.0

    def add(self, left: Array, right: Array) -> None:
        """Take in the log-likelihoods of one scan's particles, of which the first is the logged pose."""
        self._scans += 1
        a, b = ranks(left), ranks(right)
        self._same_rank += int(a[0] == b[0])
        gap = max(largest_gap(left, right), largest_gap(right, left))
        self._same_order += int(gap == 0)
        self._spearman = min(self._spearman, correlation(a, b))
        with np.errstate(invalid="ignore"):
            apart = np.where(left == right, 0.0, np.abs(left.astype(np.float64) - right))
        self._difference = max(self._difference, float(np.max(apart, initial=0.0)))
        self._gap = max(self._gap, gap)
        largest = float(np.max(np.abs(left), initial=0.0, where=np.isfinite(left)))
        tolerances = [scan_tolerance(m.precision, min(m.scanner.count, 10_000)) for m in self._models]
        allowed = sum(t.value * (1.0 if t.unit == "nats" else 1.0 + largest) for t in tolerances)
        self._allowed = max(self._allowed, allowed)

    def result(self) -> Agreement:
        """Over all scans."""
        left, right = (model.device.selection for model in self._models)
        return Agreement(
            left, right, self._scans, self._same_rank, self._same_order, self._spearman, self._difference, self._gap,
            self._allowed,
        )  # fmt: skip


def logged_scans(
    path: str | os.PathLike[str],
    *,
    range_max: float | None = None,
    every: int = 1,
    offset: int = 0,
    limit: int | None = None,
) -> list[tuple[int, Scan]]:
    """The chosen scans of a log and their numbers: ``offset``, ``offset + every``, ... up to ``limit`` of them.

    Raises:
        ValueError: the log breaks its format, none of its scans is chosen, or a chosen one has no pose.
        FileNotFoundError: it is missing.
    """
    last = None if limit is None else offset + every * limit
    chosen = list(itertools.islice(enumerate(read_log(path, range_max=range_max)), offset, last, every))
    if not chosen:
        raise ValueError(f"log: must have a scan of index {offset}, which is the first one chosen, got fewer in {path}")
    for index, scan in chosen:
        if scan.pose is None:
            raise ValueError(f"log: every scan must have a pose, got none at scan {index} of {path}")
        if scan.scanner != chosen[0][1].scanner:
            raise ValueError(f"log: every scan must come from the same scanner, got another at scan {index} of {path}")
    return chosen


def score_log(
    models: Sequence[Model],
    scans: Sequence[tuple[int, Scan]],
    cloud: Cloud,
    step: Callable[[str], None] = lambda text: None,
) -> tuple[list[BackendScore], list[Agreement]]:
    """Score every scan with every model on the same particles, and compare each two models.

    Args:
        models: The same model on one backend or several.
        scans: Scans of the models' scanner, each with its number and its pose.
        cloud: How the particles are drawn.
        step: Called with a text before each scan.
    """
    found: list[list[ScanScore]] = [[] for _ in models]
    pairs = list(itertools.combinations(range(len(models)), 2))
    comparisons = [Comparison(models[a], models[b]) for a, b in pairs]
    for index, scan in scans:
        step(f"scan {index}")
        assert scan.pose is not None
        poses = cloud.draw(index, scan.pose, models[0].grid)
        beams = evaluated_beams(models[0], scan.ranges)
        scored = []
        for model, own in zip(models, found, strict=True):
            begin = time.perf_counter()
            log_p = model.log_likelihood(poses, scan.ranges)
            own.append(score_scan(index, poses, log_p, beams, time.perf_counter() - begin))
            scored.append(log_p)
        for comparison, (a, b) in zip(comparisons, pairs, strict=True):
            comparison.add(scored[a], scored[b])
    scores = [BackendScore(m.device, cloud.particles, tuple(own)) for m, own in zip(models, found, strict=True)]
    return scores, [comparison.result() for comparison in comparisons]


def evaluated_beams(model: Model, ranges: Array) -> int:
    """How many readings of a scan a model evaluates at every particle: its hits, as far as ``beams=`` takes them."""
    kinds = classify(ranges, model.scanner)
    informative = isinstance(model.parameters, SensorTable) or model.parameters.z_max > 0
    return int(np.count_nonzero(choose_beams(kinds, model.beams, informative) & (kinds == Reading.HIT)))
