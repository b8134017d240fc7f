"""Judge whether the poses of a log fit a map, and determine the temperature of its scans."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gpusense.evaluation.scoring import Model
from gpusense.evaluation.worlds import cloud_uniform
from gpusense.localization.beam_consistency import BeamConsistency, beam_consistency
from gpusense.localization.belief import Belief
from gpusense.localization.diagnosis import Diagnosis, evidence_of
from gpusense.localization.map_judge import MapJudge
from gpusense.localization.scan_evidence import evidence_of_scan
from gpusense.localization.spread import LOST, TRACKING, Word
from gpusense.localization.temperature import BeamCorrelation, learn_from_scan
from gpusense.logs import Scan

# Number of random poses per scan, and the stream of their random numbers.
_RANDOM, _STREAM = 64, 1
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
        seed: Seed of the random poses with which a logged pose is compared.
    """

    def __init__(self, model: Model, *, seed: int = 0) -> None:
        self._model, self._seed = model, seed
        # The host judges beams for devices without float64.
        device = model.backend if model.backend.info.float64 else None
        self._belief, self._judge = Belief(), None if device is None else MapJudge(device, model.grid)
        self._scans: list[BeamConsistency] = []
        self._shares: list[float] = []
        self._better: list[float] = []
        self._p_lost: list[float] = []

    def add(self, index: int, scan: Scan) -> float:
        """Add a scan; return the share of its beams that its logged pose explains, NaN if the map can explain none."""
        random = np.random.default_rng((self._seed, index, _STREAM))
        pose = np.array(scan.pose, np.float64)
        poses = np.vstack([pose[None], cloud_uniform(self._model.grid, _RANDOM, random)])
        log_p = self._model.log_likelihood(poses, scan.ranges)
        ranges = np.asarray(scan.ranges, np.float64)
        found = beam_consistency(self._model.grid, scan.scanner, pose, ranges, judge=self._judge)
        (ratio, share), better = evidence_of_scan([found]), math.nan
        # Readings that are equally likely or impossible everywhere are no evidence.
        if np.isfinite(log_p).any() and (log_p != log_p[0]).any():
            better = float(np.mean(log_p[1:] < log_p[0]))
            ratio += _ratio_of_rank(better)
        x, y, theta = (float(value) for value in pose)
        self._belief = self._belief.counted().judged((x, y, theta), ratio)
        if not math.isnan(ratio):
            self._scans.append(found)
            self._shares.append(share)
            self._better += [] if math.isnan(better) else [better]
            self._p_lost.append(self._belief.wrong)
        return share

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
