"""Whether the poses of a log fit a map, and the temperature that its scans call for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gpusense.evaluation.agreement import Model
from gpusense.evaluation.worlds import cloud_uniform
from gpusense.localization.belief import Belief
from gpusense.localization.diagnosis import Diagnosis, evidence_of
from gpusense.localization.passages import Passages, passages
from gpusense.localization.ratio import explained_of_scan, ratio_of_scan
from gpusense.localization.temperature import BeamCorrelation, learn_from_scan
from gpusense.localization.words import LOST, TRACKING, Word
from gpusense.logs import Scan

# Random poses of a scan, and the stream of their random numbers.
_RANDOM, _STREAM = 64, 1
# Least share of the random poses that a logged pose excels: 1/2 by chance.
LEAST_BETTER = 0.9
# The share b of random poses that score lower has the density EXCELS b^(EXCELS - 1) at right poses, and 1 at wrong
# poses; the log-likelihood ratio is limited.
_EXCELS, _LIMIT = 20, 3.0


@dataclass(frozen=True)
class Fitness:
    """How well the logged poses explain their scans.

    Attributes:
        scans: Scans that tell anything.
        explained: Median share of the beams that the logged poses explain; None without such scans.
        better: Median share of poses anywhere in the free space at which a scan is less likely, or None.
        p_lost: Median over the scans of the probability that the logged pose is wrong, or None.
        evidence: Beams of all scans.
    """

    scans: int
    explained: float | None
    better: float | None
    p_lost: float | None
    evidence: Diagnosis

    @property
    def verdict(self) -> Word:
        """Return "tracking" for a log of this map, "lost" for one of another map, and "uncertain" between."""
        if self.p_lost is None:
            return "uncertain"
        if self.p_lost > LOST:
            return "lost"
        better = self.better is None or self.better >= LEAST_BETTER
        return "tracking" if self.p_lost <= TRACKING and better else "uncertain"

    @property
    def fits(self) -> bool:
        """Tell whether the log is one of this map; False where no scan could be judged."""
        return self.verdict == "tracking"


class FitnessOfLog:
    """Running judgement of a log's poses, scan by scan.

    Args:
        model: A model on the map.
        seed: Seed of the random poses with which a logged pose is compared.
    """

    def __init__(self, model: Model, *, seed: int = 0) -> None:
        self._model, self._seed = model, seed
        self._belief = Belief()
        self._scans: list[Passages] = []
        self._shares: list[float] = []
        self._better: list[float] = []
        self._p_lost: list[float] = []

    def add(self, index: int, scan: Scan) -> float:
        """Return the share of a scan's beams that its logged pose explains; NaN where the map could explain none."""
        random = np.random.default_rng((self._seed, index, _STREAM))
        pose = np.array(scan.pose, np.float64)
        poses = np.vstack([pose[None], cloud_uniform(self._model.grid, _RANDOM, random)])
        log_p = self._model.log_likelihood(poses, scan.ranges)
        found = passages(self._model.grid, scan.scanner, pose, np.asarray(scan.ranges, np.float64))
        share, ratio, better = explained_of_scan([found]), ratio_of_scan([found]), math.nan
        # Readings that are equally likely or impossible everywhere tell nothing.
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
        if p_lost is not None and p_lost > LOST:
            evidence = replace(evidence, cause="map")
        return Fitness(len(self._scans), explained, better, p_lost, evidence)


def _ratio_of_rank(better: float) -> float:
    """Return the log-likelihood ratio of a wrong pose against a right one, given the share of poses that it excels."""
    ratio = math.inf if better == 0 else -math.log(_EXCELS) - (_EXCELS - 1) * math.log(better)
    return min(max(ratio, -_LIMIT), _LIMIT)


def temperature_of_log(model: Model, scans: Sequence[tuple[int, Scan]], *, most: int = 100) -> float:
    """Return the temperature of scans at their logged poses, as a filter with ``temperature="auto"`` learns it.

    Args:
        model: A model on the map, with temperature 1.
        scans: Scans with poses, and their indices.
        most: Scans to learn from: the first ones.
    """
    correlation = BeamCorrelation()
    for _, scan in scans[:most]:
        learn_from_scan(correlation, model, scan.ranges, np.array(scan.pose))
    return correlation.temperature(model.used_beams)
