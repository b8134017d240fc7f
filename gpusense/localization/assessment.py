"""Compute a filter's estimate: pose, probability of being lost by scans and particles, and verdict."""

from __future__ import annotations

import numpy as np

from gpusense.localization.estimates import Estimate, clustered
from gpusense.localization.pose_algebra import wrap_angle
from gpusense.localization.protection import Distances, margins_of
from gpusense.localization.recovery import Recovery
from gpusense.localization.spread import share_off, share_off_of, spread_of
from gpusense.localization.tracker import Tracker
from gpusense.localization.verdict import Verdict
from gpusense.localization.words import verdict_label


def estimate_of(tracker: Tracker, verdict: Verdict, recovery: Recovery, method: str) -> Estimate:
    """Return the estimate of a filter.

    Args:
        tracker: The particles.
        verdict: Verdict on their pose.
        recovery: Recovery with the rivals of the particles.
        method: "mean", "cluster" or "best".
    """
    cloud, shown = tracker.cloud, tracker.shown
    mean, covariance = tracker.mean_and_covariance()
    pose, about = mean, covariance
    summary = cloud.summary()
    if method == "best":
        pose = tracker.host_particles()[int(np.argmax(cloud.host_weights(shown)))]
    elif method == "cluster":
        pose, covariance = clustered(tracker.host_particles(), cloud.host_weights(shown))
    if method != "mean":
        offset = pose - mean
        offset[2] = wrap_angle(offset[2])
        about = about + np.outer(offset, offset)
    share, distances = share_off(about), None
    if not spread_of(about).narrow:
        particles = cloud.snapshot(shown)
        share = cloud.far_share(shown) if method == "mean" else share_off_of(*particles(), pose)
        distances = Distances(particles, pose)
    if recovery.rival is not None:
        share = 1 - (1 - share) * (1 - recovery.rival.probability(pose))
    wrong = verdict.wrong
    p_lost, spread = wrong + (1 - wrong) * share, spread_of(covariance)
    word = verdict_label(p_lost, wrong, wide=spread.wide, apart=spread.apart)
    temperature = tracker.sensors[0].temperature(tracker.options.temperature)
    margins = margins_of(tracker.sensors) if verdict.informed and verdict.state.corrections else (1.0, 0.0)
    return Estimate(
        pose, covariance, tracker.sample_size(), p_lost, word, verdict.state.explained, temperature,
        summary.temperature, summary.degenerate, shown, *margins,
        None if method == "mean" else about, distances,
    )  # fmt: skip
