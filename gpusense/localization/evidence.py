"""Whether a filter is lost among landmarks: how much better its particles predict features than poses anywhere.

Before each correction, log of the mean likelihood of the features over the particles is compared with the larger of two
chances: the mean over poses anywhere among the landmarks, and features that are all false positives. The difference, in
nats for each feature, is the logarithm of a Bayes factor (Jeffreys 1961). A filter that follows the robot gains several
nats; one on a wrong map, or at a wrong place, gains none, and noise that was fitted to a wrong map cannot hide it.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense.models.landmark.model import LandmarkModel

Floats = NDArray[np.float64]

# Least gain of a filter that is not lost [nats for a feature]; scans with features over which it is averaged; poses
# anywhere, and their margin around the landmarks [m].
LEAST_GAIN, _MEMORY, _ANYWHERE, _MARGIN = 1.0, 20, 1000, 1.0


class Evidence:
    """Running gain of the predictions of features.

    Args:
        model: The model of the landmarks.
        seed: Seed of the poses anywhere.
    """

    def __init__(self, model: LandmarkModel, *, seed: int = 0) -> None:
        self._model = model
        xy, rng = model.landmarks.xy, np.random.default_rng(seed)
        low, high = xy.min(axis=0) - _MARGIN, xy.max(axis=0) + _MARGIN
        self._poses = np.column_stack(
            [rng.uniform(low, high, (_ANYWHERE, 2)), rng.uniform(-math.pi, math.pi, _ANYWHERE)]
        )
        self._recent: deque[tuple[float, int]] = deque(maxlen=_MEMORY)

    def predicted(self, poses: Floats, weights: Floats, features: Floats) -> None:
        """Add a scan, before the filter is corrected by it.

        Landmarks count as unknown: where two are exchanged in the map, a pose is right all the same.

        Args:
            poses: (N, 3) predicted particles.
            weights: (N,) their weights.
            features: (F, 2 or 3) features of the scan, F > 0.
        """
        count = len(features)
        false = self._log_p(self._poses[:1], features, np.full(count, -1))[0]
        z_false = self._model.parameters.z_false
        chance = _log_mean(self._log_p(self._poses, features), np.full(_ANYWHERE, 1 / _ANYWHERE))
        if z_false > 0:
            chance = max(chance, float(false) - count * math.log(z_false))
        reached = _log_mean(self._log_p(poses, features), weights)
        if math.isfinite(chance) or math.isfinite(reached):
            self._recent.append((reached - chance, count))

    def _log_p(self, poses: Floats, features: Floats, ids: Any = None) -> Floats:
        return np.asarray(self._model.log_likelihood(poses, features, ids), np.float64)

    @property
    def gain(self) -> float:
        """Mean gain of recent features [nats]; NaN before there are enough scans."""
        if len(self._recent) < _MEMORY:
            return math.nan
        return sum(gain for gain, _ in self._recent) / sum(count for _, count in self._recent)

    @property
    def lost(self) -> bool:
        """Tell whether recent features are hardly likelier than by chance; False before there are enough scans."""
        return self.gain < LEAST_GAIN


def _log_mean(log_p: Floats, weights: Floats) -> float:
    """Return the logarithm of a weighted mean of likelihoods."""
    largest = float(log_p.max())
    if not math.isfinite(largest):
        return largest
    with np.errstate(divide="ignore"):
        return largest + float(np.log(weights @ np.exp(log_p - largest)))
