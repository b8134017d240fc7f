"""Find evidence of being lost among landmarks: the gain of particles over chance in predicting features.

Before each correction, the mean likelihood of the features over the particles is compared with the larger of two
alternatives: the mean over poses anywhere among the landmarks, and the likelihood of false positives only. The
difference, in nats per feature, is the logarithm of a Bayes factor (Jeffreys 1961). A filter that follows the robot
gains several nats. A filter on a wrong map or at a wrong place gains none, even with noise fitted to a wrong map.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from gpusense._util.typing import Floats
from gpusense.models.landmark.base import FeatureModel

# Gain at which right and wrong are equally likely [nats per feature]; scans in the average; number of poses anywhere,
# and their margin around the landmarks [m].
LEAST_GAIN, MEMORY, _ANYWHERE, _MARGIN = 1.0, 20, 1000, 1.0


class Evidence:
    """Gain in predicting features of a model of landmarks or lines."""

    def __init__(self, model: FeatureModel, *, seed: int = 0) -> None:
        self._model = model
        xy, rng = model.corners, np.random.default_rng(seed)
        low, high = xy.min(axis=0) - _MARGIN, xy.max(axis=0) + _MARGIN
        self._poses = np.column_stack(
            [rng.uniform(low, high, (_ANYWHERE, 2)), rng.uniform(-math.pi, math.pi, _ANYWHERE)]
        )

    def gain(self, poses: Floats, weights: Floats, features: Floats) -> float:
        """Return the gain of (N, 3) predicted particles over chance in predicting (F, ...) features [nats].

        Landmarks count as unidentified, since exchanged landmarks of a map leave a right pose right. The gain is NaN if
        neither particles nor chance can explain the features.
        """
        count = len(features)
        false = self._log_p(self._poses[:1], features, np.full(count, -1))[0]
        z_false = self._model.parameters.z_false
        chance = _log_mean(self._log_p(self._poses, features), np.full(_ANYWHERE, 1 / _ANYWHERE))
        if z_false > 0:
            chance = max(chance, float(false) - count * math.log(z_false))
        reached = _log_mean(self._log_p(poses, features), weights)
        return reached - chance if math.isfinite(chance) or math.isfinite(reached) else math.nan

    def _log_p(self, poses: Floats, features: Floats, ids: Any = None) -> Floats:
        return np.asarray(self._model.log_likelihood(poses, features, ids), np.float64)


class Gains(NamedTuple):
    """Gains [nats] and numbers of features of the last ``MEMORY`` scans; immutable."""

    recent: tuple[tuple[float, int], ...] = ()

    def added(self, gain: float, count: int) -> Gains:
        """Return the gains after adding a scan."""
        return Gains((*self.recent, (gain, count))[-MEMORY:])

    @property
    def mean(self) -> float:
        """Mean gain per feature [nats]; NaN without enough scans."""
        if len(self.recent) < MEMORY:
            return math.nan
        return sum(gain for gain, _ in self.recent) / sum(count for _, count in self.recent)


def _log_mean(log_p: Floats, weights: Floats) -> float:
    """Return the logarithm of a weighted mean of likelihoods."""
    largest = float(log_p.max())
    if not math.isfinite(largest):
        return largest
    with np.errstate(divide="ignore"):
        return largest + float(np.log(weights @ np.exp(log_p - largest)))
