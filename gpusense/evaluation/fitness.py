"""Whether the poses of a log fit a map, and the temperature that its scans call for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gpusense.evaluation.agreement import Model
from gpusense.evaluation.worlds import cloud_uniform
from gpusense.localization.temperature import BeamCorrelation, learn_from_scan
from gpusense.localization.verdict import explained_share
from gpusense.logs import Scan

# Random poses of a scan, and the stream of their random numbers.
_RANDOM, _STREAM = 64, 1
# Least share of explained beams of a log on its own map. The beam model and the field have 73 to 100 % there (intel,
# csail, fr079, aces), and 0 to 30 % on another map. A filter's share is larger: it moves to where scans fit best.
LEAST_EXPLAINED = 0.5
# Least share of the random poses that a logged pose excels: 1/2 by chance.
LEAST_BETTER = 0.9


@dataclass(frozen=True)
class Fitness:
    """How well the logged poses explain their scans.

    Attributes:
        scans: Scans with at least one beam.
        explained: Median share of the beams that the logged poses explain; None without such scans.
        better: Median share of poses anywhere in the free space at which a scan is less likely, or None.
    """

    scans: int
    explained: float | None
    better: float | None

    @property
    def fits(self) -> bool:
        """Tell whether the log is one of this map; True where no scan could be judged."""
        if self.explained is None or self.better is None:
            return True
        return self.explained >= LEAST_EXPLAINED and self.better >= LEAST_BETTER


class FitnessOfLog:
    """Running judgement of a log's poses, scan by scan.

    Args:
        model: A model on the map.
        seed: Seed of the random poses with which a logged pose is compared.
    """

    def __init__(self, model: Model, *, seed: int = 0) -> None:
        self._model, self._seed = model, seed
        self._shares: list[float] = []
        self._better: list[float] = []

    def add(self, index: int, scan: Scan) -> float:
        """Return the share of a scan's beams that its logged pose explains; NaN where readings do not depend on it."""
        random = np.random.default_rng((self._seed, index, _STREAM))
        poses = np.vstack([np.array([scan.pose]), cloud_uniform(self._model.grid, _RANDOM, random)])
        log_p, terms = self._model.log_likelihood(poses, scan.ranges, per_beam=True)
        parts = np.asarray(terms, np.float64)
        share = explained_share(parts[0], parts[1:])
        # Readings that are alike at all poses, as no returns, tell nothing.
        if np.isfinite(log_p[0]) and (log_p == log_p[0]).all():
            return math.nan
        if not math.isnan(share):
            self._shares.append(share)
            self._better.append(float(np.mean(log_p[1:] < log_p[0])))
        return share

    def result(self) -> Fitness:
        """Return the judgement of the scans so far."""
        explained, better = (float(np.median(v)) if v else None for v in (self._shares, self._better))
        return Fitness(len(self._shares), explained, better)


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
