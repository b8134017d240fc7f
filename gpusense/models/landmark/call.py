"""A call of the landmark model: the values that all particles share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpusense.models.landmark.features import PreparedFeatures
from gpusense.world.landmarks import Buckets


@dataclass(frozen=True)
class Call:
    """Values that all particles of a call share.

    Attributes:
        prepared: The evaluated features.
        places: Places of the landmarks of known features among the buckets.
        fixed: The constant term: log-likelihoods of known false positives.
        flags: Flags of the scoring kernel.
        joint: Whether the features are assigned jointly.
    """

    prepared: PreparedFeatures
    places: np.ndarray
    fixed: float
    flags: frozenset[str]
    joint: bool

    @property
    def count(self) -> int:
        """Number of evaluated features."""
        return len(self.prepared.columns)


def known_features(
    prepared: PreparedFeatures, partner: np.ndarray, buckets: Buckets
) -> tuple[PreparedFeatures, np.ndarray, float]:
    """Return the features with a landmark, the places of these, and the constant term of the false positives.

    Args:
        prepared: The features.
        partner: (K,) landmark of each, -1 for a false positive, which is the same at every pose.
        buckets: The landmarks in buckets.
    """
    known = partner >= 0
    constant = float(prepared.false[prepared.columns[~known]].sum())
    features = PreparedFeatures(
        prepared.columns[known], prepared.numbers[known], prepared.measured[known], prepared.false
    )
    return features, buckets.place_of[partner[known]], constant
