"""Score the scans of a log for clouds of particles and rank the logged poses.

The particles of a scan are the logged pose, poses around it, and as many poses uniform over the map's free cells. The
logged pose is ranked among them. The weighted mean excludes it, since it would bias the mean.
"""

from __future__ import annotations

import itertools
import math
import os
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Unpack, cast

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks
from gpusense._util.typing import Floats
from gpusense.backends import BackendInfo
from gpusense.evaluation.worlds import cloud_around, cloud_uniform
from gpusense.localization.weights import normalize_weights
from gpusense.logs import Pose, Scan
from gpusense.logs.reader import LogOptions, read_laser
from gpusense.logs.records import check_scanner
from gpusense.models.scan.beam import BeamModel
from gpusense.models.scan.field import LikelihoodFieldModel
from gpusense.models.scan.rules import choose_beams
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Reading, classify
from gpusense.world.sensor_table import SensorTable

Array = NDArray[Any]
Model = BeamModel | LikelihoodFieldModel


@dataclass(frozen=True)
class ParticleSampler:
    """Sampler of the particles of a scan.

    Attributes:
        sigma_position: Deviation of the particles around the logged pose, in x and in y, >= 0 [m].
        sigma_heading: Deviation of their headings, >= 0 [rad].
        seed: Seed; each scan has a separate random stream, so its particles do not depend on the chosen scans.
    """

    particles: int = 20_000
    sigma_position: float = 0.5
    sigma_heading: float = 0.25
    seed: int = 0

    def __post_init__(self) -> None:
        checks.integer("particles", self.particles, low=2)
        checks.integer("seed", self.seed, low=0)

    def draw(self, index: int, pose: Pose, grid: OccupancyGrid) -> Floats:
        """Draw (N, 3) particles of a scan: its pose, particles around it, particles over all free cells [m, m, rad]."""
        random = np.random.default_rng((self.seed, index))
        near = (self.particles - 1) // 2
        around = cloud_around(pose, near, self.sigma_position, self.sigma_heading, random)
        return np.concatenate([[pose], around, cloud_uniform(grid, self.particles - 1 - near, random)])


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
        effective: Effective sample size of the other particles, or None.
        degenerate: Whether every other particle has probability 0.
        beams: Readings that are evaluated at every particle.
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
        weights, effective = normalized.weights, normalized.effective_sample_size
        x, y = (weights @ poses[1:, :2]).tolist()
        theta = math.atan2(float(weights @ np.sin(poses[1:, 2])), float(weights @ np.cos(poses[1:, 2])))
        mean = (x, y, theta)
        position = math.hypot(x - pose[0], y - pose[1])
        heading = abs(math.remainder(theta - pose[2], math.tau))
    return ScanScore(
        index, pose, 1 + better + equal / 2, 100 * (others - better - equal / 2) / others, mean, position, heading,
        effective, normalized.degenerate, beams, seconds,
    )  # fmt: skip


def summary(score: LogScore) -> dict[str, Any]:
    """Return medians, 90 % quantiles and extremes over the scans; None if no scan has a value."""

    def over_scans(pick: Callable[[ScanScore], float | None], take: Callable[[Sequence[float]], float]) -> float | None:
        values = [value for value in map(pick, score.scans) if value is not None]
        return take(values) if values else None

    def quantile_90(values: Sequence[float]) -> float:
        return sorted(values)[min(math.ceil(0.9 * len(values)), len(values)) - 1]

    middle = statistics.median
    return {
        "scans": len(score.scans),
        "rank_median": over_scans(lambda s: s.rank, middle),
        "percentile_median": over_scans(lambda s: s.percentile, middle),
        "percentile_min": over_scans(lambda s: s.percentile, min),
        "error_position_median": over_scans(lambda s: s.error_position, middle),
        "error_position_90": over_scans(lambda s: s.error_position, quantile_90),
        "error_position_max": over_scans(lambda s: s.error_position, max),
        "error_heading_median": over_scans(lambda s: s.error_heading, middle),
        "error_heading_90": over_scans(lambda s: s.error_heading, quantile_90),
        "effective_median": over_scans(lambda s: s.effective, middle),
        "degenerate": sum(s.degenerate for s in score.scans),
        "particle_beams_per_second": score.particle_beams_per_second,
    }


def chosen_scans(
    path: str | os.PathLike[str],
    *,
    every: int = 1,
    offset: int = 0,
    limit: int | None = None,
    topic: str | None = None,
    **options: Unpack[LogOptions],
) -> list[tuple[int, Scan]]:
    """Read scans of a log with their indices: ``offset``, ``offset + every``, ..., at most ``limit`` scans.

    ``limit``: Largest number of scans; None for all. ``topic``: The laser, see :func:`gpusense.logs.reader.read_laser`;
    None for the only or main laser.
    """
    last = None if limit is None else offset + every * limit
    scans = read_laser(path, topic, **options)
    chosen = list(itertools.islice(enumerate(scans), offset, last, every))
    if not chosen:
        raise ValueError(f"log: must have a scan of index {offset}, the first one chosen, got fewer scans in {path}")
    return chosen


def with_poses(scans: list[tuple[int, Scan]], path: str | os.PathLike[str]) -> list[tuple[int, Scan]]:
    """Return numbered scans of a log, which must have poses and one scanner."""
    check_poses(scans, path)
    return with_one_scanner(scans, path)


def check_poses(scans: list[tuple[int, Scan]], path: str | os.PathLike[str]) -> None:
    """Check that numbered scans of a log have poses."""
    for index, scan in scans:
        if scan.pose is None:
            rule = "every scan must have a pose, of its own or by --reference"
            raise ValueError(
                f"log: {rule}, got none at scan {index} of {path}; trajectories for --reference: of a SLAM program, of "
                "'gpusense localize --tum' in a map, of 'gpusense map --tum' without one"
            )


def with_one_scanner(scans: list[tuple[int, Scan]], path: str | os.PathLike[str]) -> list[tuple[int, Scan]]:
    """Return numbered scans of a log, which must have one scanner."""
    for index, scan in scans:
        check_scanner(scan, scans[0][1].scanner, f"scan {index} of {path}")
    return scans


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
        self._scores.append(score_scan(index, poses, log_p, evaluated_beams(self._model, scan.ranges), seconds))
        return self._scores[-1]

    def result(self) -> LogScore:
        """Return the scores of the scans so far."""
        return LogScore(self._model.device, self._sampler.particles, tuple(self._scores))


def evaluated_beams(model: Model, ranges: Array) -> int:
    """Count the readings of a scan that a model evaluates at every particle: its hits after thinning by ``beams=``."""
    kinds = classify(ranges, model.scanner)
    informative = isinstance(model.parameters, SensorTable) or model.parameters.z_max > 0
    return int(np.count_nonzero(choose_beams(kinds, model.beams, informative) & (kinds == Reading.HIT)))
