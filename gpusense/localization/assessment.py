"""The estimate of a filter: its pose, the probability of being lost by scans and particles, and the verdict."""

from __future__ import annotations

import numpy as np

from gpusense.localization.estimates import Estimate, clustered
from gpusense.localization.recovery import Recovery
from gpusense.localization.spread import Spread, share_off, share_off_of, spread_of
from gpusense.localization.tracker import Tracker
from gpusense.localization.verdict import Verdict
from gpusense.localization.words import word_of

# Most particles whose spread is counted one by one; larger narrow clouds are approximated by a normal density.
_MOST_LOOKED_AT = 100_000


def estimate_of(tracker: Tracker, verdict: Verdict, recovery: Recovery, method: str) -> Estimate:
    """Return the estimate of a filter.

    Args:
        tracker: The particles.
        verdict: Verdict on their pose.
        recovery: Recovery with the rivals of the particles.
        method: "mean", "cluster" or "best".
    """
    cloud, shown = tracker.cloud, tracker.shown
    pose, covariance = tracker.mean_and_covariance()
    summary = cloud.summary()
    if method == "best":
        pose = tracker.host_particles()[int(np.argmax(cloud.host_weights(shown)))]
    elif method == "cluster":
        pose, covariance = clustered(tracker.host_particles(), cloud.host_weights(shown))
    spread = spread_of(covariance)
    p_lost = _p_lost(tracker, verdict, recovery, pose, covariance, spread)
    word = word_of(p_lost, verdict.wrong, wide=spread.wide, apart=spread.apart)
    temperature = tracker.sensors[0].temperature(tracker.options.temperature)
    return Estimate(
        pose, covariance, tracker.sample_size(), p_lost, word, verdict.state.explained, temperature,
        summary.temperature, summary.degenerate, shown,
    )  # fmt: skip


def _p_lost(
    tracker: Tracker, verdict: Verdict, recovery: Recovery, pose: np.ndarray, covariance: np.ndarray, spread: Spread
) -> float:
    """Return the probability that a pose is far off, according to scans and particles."""
    if spread.narrow or tracker.shown > _MOST_LOOKED_AT:
        share = share_off(covariance)
    else:
        share = share_off_of(tracker.host_particles(), tracker.cloud.host_weights(tracker.shown), pose)
    if recovery.rival is not None:
        share = 1 - (1 - share) * (1 - recovery.rival.probability(pose))
    wrong = verdict.wrong
    return wrong + (1 - wrong) * share
