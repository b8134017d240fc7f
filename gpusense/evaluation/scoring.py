"""Score the scans of a log for clouds of particles and rank the logged poses.

The particles of a scan are the logged pose, poses around it, and as many poses uniform over the map's free cells. The
logged pose is ranked among them. The weighted mean excludes it, since it would bias the mean.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks
from gpusense._util.typing import Floats
from gpusense.backends import BackendInfo, get_backend
from gpusense.evaluation.worlds import cloud_around, cloud_uniform
from gpusense.localization.beam_consistency import BeamConsistency, MapJudge
from gpusense.localization.belief import Belief, evidence_of_scan
from gpusense.localization.diagnosis import Diagnosis, evidence_of
from gpusense.localization.spread import LOST, TRACKING, Word
from gpusense.localization.temperature import BeamCorrelation, learn_from_scan
from gpusense.localization.weights import normalize_weights
from gpusense.logs import Pose, Scan
from gpusense.models.scan.beam import BeamModel
from gpusense.models.scan.classed import choose_beams
from gpusense.models.scan.field import LikelihoodFieldModel
from gpusense.world.grid import OccupancyGrid
from gpusense.world.pose_algebra import mean_pose
from gpusense.world.scanner import Reading, classify
from gpusense.world.sensor_parameters import SensorTable

Array = NDArray[Any]
Model = BeamModel | LikelihoodFieldModel


@dataclass(frozen=True)
class ParticleSampler:
    """Sampler of the particles of a scan.

    Attributes:
        sigma_position: Deviation of the particles around the logged pose, in x and in y, >= 0 [m].
        seed: Seed; each scan has a separate random stream, so its particles do not depend on the chosen scans.
    """

    particles: int = 20_000
    sigma_position: float = 0.5
    sigma_heading: float = 0.25
    seed: int = 0

    def __post_init__(self) -> None:
        checks.integer("particles", self.particles, low=2)
        checks.integer("seed", self.seed, low=0)

    @property
    def near(self) -> int:
        """Number of the particles around the logged pose."""
        return (self.particles - 1) // 2

    def draw(self, index: int, pose: Pose, grid: OccupancyGrid) -> Floats:
        """Draw (N, 3) particles of a scan: its pose, particles around it, particles over all free cells [m, m, rad]."""
        random = np.random.default_rng((self.seed, index))
        around = cloud_around(pose, self.near, self.sigma_position, self.sigma_heading, random)
        return np.concatenate([[pose], around, cloud_uniform(grid, self.particles - 1 - self.near, random)])


@dataclass(frozen=True)
class ScanScore:
    """Score of one scan.

    Attributes:
        index: Index of the scan in its log, from 0.
        rank: Rank of the logged pose, 1 for the best; the mean rank if particles tie with it.
        percentile: Share of the other particles that score worse, with half of the ties [%].
        mean: Weighted mean of the other particles, with the circular mean of headings; None if all weights are 0.
        error_position: Distance of the mean from the logged pose [m], or None.
        error_heading: Absolute difference of heading, 0 to pi [rad], or None.
        beams: Readings that are evaluated at every particle.
        better: Share of the particles anywhere in the free space at which the scan is less likely than at the logged
            pose; None if it is equally likely or impossible at all of them.
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
    better: float | None = None


@dataclass(frozen=True)
class LogScore:
    """Scores of all scans."""

    device: BackendInfo
    particles: int
    scans: tuple[ScanScore, ...]

    @property
    def particle_beams_per_second(self) -> float | None:
        """Return evaluated readings per second; the first of several scans, which compiles, is left out."""
        steady = self.scans[1:] or self.scans
        seconds = sum(scan.seconds for scan in steady)
        return self.particles * sum(scan.beams for scan in steady) / seconds if seconds > 0 else None


def score_scan(index: int, poses: Floats, log_p: Array, beams: int, seconds: float) -> ScanScore:
    """Rank the logged pose, the first of (N, 3) particles with (N,) log-likelihoods, and average the others."""
    better, equal = np.count_nonzero(log_p[1:] > log_p[0]), np.count_nonzero(log_p[1:] == log_p[0])
    others = len(log_p) - 1
    normalized = normalize_weights(log_p[1:])
    pose = cast(Pose, tuple(poses[0].tolist()))
    mean: Pose | None = None
    position = heading = effective = None
    if not normalized.degenerate:
        effective, centre = normalized.effective_sample_size, mean_pose(poses[1:], normalized.weights)
        mean, off = cast(Pose, tuple(centre.tolist())), centre - poses[0]
        position, heading = math.hypot(off[0], off[1]), abs(math.remainder(off[2], math.tau))
    return ScanScore(
        index, pose, 1 + better + equal / 2, 100 * (others - better - equal / 2) / others, mean, position, heading,
        effective, normalized.degenerate, beams, seconds,
    )  # fmt: skip


# Figures over scans: an attribute of their scores, and how it is summarised.
_FIGURES = (
    "rank_median", "percentile_median", "percentile_min", "error_position_median", "error_position_90",
    "error_position_max", "error_heading_median", "error_heading_90", "effective_median",
)  # fmt: skip
_TAKE: dict[str, Callable[[list[float]], Any]] = {
    "median": np.median, "90": lambda values: np.quantile(values, 0.9, method="inverted_cdf"), "min": min, "max": max,
}  # fmt: skip


def summary(score: LogScore) -> dict[str, Any]:
    """Return medians, 90 % quantiles and extremes over the scans; None if no scan has a value."""
    figures: dict[str, Any] = {"scans": len(score.scans)}
    for figure in _FIGURES:
        name, _, kind = figure.rpartition("_")
        values = [value for scan in score.scans if (value := getattr(scan, name)) is not None]
        figures[figure] = float(_TAKE[kind](values)) if values else None
    figures["degenerate"] = sum(scan.degenerate for scan in score.scans)
    return figures | {"particle_beams_per_second": score.particle_beams_per_second}


class LogScoring:
    """Scores of a log's scans, scan by scan."""

    def __init__(self, model: Model, sampler: ParticleSampler) -> None:
        """Prepare to score particles of a sampler."""
        self._model, self._sampler = model, sampler
        self._scores: list[ScanScore] = []

    def __len__(self) -> int:
        """Return the number of scored scans."""
        return len(self._scores)

    def add(self, index: int, scan: Scan) -> ScanScore:
        """Score a scan."""
        assert scan.pose is not None
        poses = self._sampler.draw(index, scan.pose, self._model.grid)
        begin = time.perf_counter()
        log_p = self._model.log_likelihood(poses, scan.ranges)
        seconds = time.perf_counter() - begin
        score = score_scan(index, poses, log_p, evaluated_beams(self._model, scan.ranges), seconds)
        anywhere = log_p[1 + self._sampler.near :]
        # Readings that are equally likely or impossible everywhere are no evidence.
        if np.isfinite(log_p).any() and (anywhere != log_p[0]).any():
            score = replace(score, better=float(np.mean(anywhere < log_p[0])))
        self._scores.append(score)
        return score

    def result(self) -> LogScore:
        """Return the scores of the scans so far."""
        return LogScore(self._model.device, self._sampler.particles, tuple(self._scores))


def evaluated_beams(model: Model, ranges: Array) -> int:
    """Count the readings of a scan that a model evaluates at every particle: its hits after thinning by ``beams=``."""
    kinds = classify(ranges, model.scanner)
    informative = isinstance(model.parameters, SensorTable) or model.parameters.z_max > 0
    return int(np.count_nonzero(choose_beams(kinds, model.beams, informative) & (kinds == Reading.HIT)))


# Least share of random poses that a right logged pose excels; it is 1/2 by chance.
LEAST_BETTER = 0.9
# The share b of random poses that score lower has the density EXCELS b^(EXCELS - 1) at right poses, and 1 at wrong
# poses; the log-likelihood ratio is limited.
_EXCELS, _LIMIT = 20, 3.0


@dataclass(frozen=True)
class Fitness:
    """Agreement of logged poses with their scans.

    Attributes:
        scans: Number of scans that give evidence.
        explained: Median share of the beams that the logged poses explain; None without such scans.
        better: Median share of poses anywhere in the free space at which a scan is less likely; None without such
            scans.
        p_lost: Median over the scans of the probability that the logged pose is wrong; None without such scans.
    """

    scans: int
    explained: float | None
    better: float | None
    p_lost: float | None
    evidence: Diagnosis

    @property
    def verdict(self) -> Word:
        """Return "tracking" for a log of this map, "lost" for a log of another map, and "uncertain" in between."""
        if self.p_lost is None:
            return "uncertain"
        if self.p_lost > LOST:
            return "lost"
        better = self.better is None or self.better >= LEAST_BETTER
        return "tracking" if self.p_lost <= TRACKING and better else "uncertain"

    @property
    def fits(self) -> bool:
        """Tell whether the log belongs to this map; False if no scan could be judged."""
        return self.verdict == "tracking"


class FitnessOfLog:
    """Running judgement of a log's poses, scan by scan.

    Args:
        model: A model on the map.
    """

    def __init__(self, model: Model) -> None:
        # The host judges beams for devices without float64.
        device = model.backend if model.backend.info.float64 else get_backend("numpy")
        self._belief, self._judge = Belief(), MapJudge(device, model.grid)
        self._scans: list[BeamConsistency] = []
        self._shares: list[float] = []
        self._better: list[float] = []
        self._p_lost: list[float] = []

    def add(self, scan: Scan, better: float | None) -> None:
        """Add a scan with its :attr:`ScanScore.better`."""
        pose, ranges = np.array(scan.pose, np.float64), np.asarray(scan.ranges, np.float64)
        found = self._judge.consistency(scan.scanner, pose, ranges)
        ratio, share = evidence_of_scan([found])
        ratio += 0.0 if better is None else _ratio_of_rank(better)
        x, y, theta = (float(value) for value in pose)
        self._belief = self._belief.counted().judged((x, y, theta), ratio)
        if not math.isnan(ratio):
            self._scans.append(found)
            self._shares.append(share)
            self._better += [] if better is None else [better]
            self._p_lost.append(self._belief.wrong)

    def result(self) -> Fitness:
        """Return the judgement of the scans so far."""
        known = [share for share in self._shares if not math.isnan(share)]
        explained, better, p_lost = (
            float(np.median(values)) if values else None for values in (known, self._better, self._p_lost)
        )
        evidence = evidence_of(self._scans)
        if p_lost is not None:
            evidence = replace(evidence, cause="map" if p_lost > LOST else "none")
        return Fitness(len(self._scans), explained, better, p_lost, evidence)


def _ratio_of_rank(better: float) -> float:
    """Return the log-likelihood ratio of a wrong pose against a right one, given the share of poses that it excels."""
    ratio = math.inf if better == 0 else -math.log(_EXCELS) - (_EXCELS - 1) * math.log(better)
    return min(max(ratio, -_LIMIT), _LIMIT)


def temperature_of_log(model: Model, scans: Sequence[tuple[int, Scan]], *, most: int = 100) -> float:
    """Return the temperature of scans at their logged poses, as a filter with ``temperature="auto"`` learns it."""
    correlation = BeamCorrelation()
    for _, scan in scans[:most]:
        learn_from_scan(correlation, model, scan.ranges, np.array(scan.pose))
    return correlation.temperature(model.used_beams)
