"""Estimate the robot's pose from weighted particles."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from gpusense._util.html import card, pose_rows
from gpusense.localization.spread import LEAST_SAMPLE, Distances, JudgedPose, Word
from gpusense.world.pose_algebra import mean_pose, wrap_angle

# Bins of positions and headings [m, rad]; neighbouring bins belong to one cluster.
_BIN, _BIN_TURN = 0.5, 0.35


@dataclass(frozen=True)
class Estimate(JudgedPose):
    """Pose of the robot according to the particles.

    Attributes:
        pose: (3,) x, y, theta [m, m, rad].
        covariance: (3, 3) covariance of the particles about the pose.
        effective_sample_size: ``1 / sum w^2`` of the last correction, 1 to N; until the next motion, copies of a
            particle count once.
        p_lost: Probability that the pose is off by more than 1 m or 0.5 rad; see ``docs/localization.md``.
        verdict: "tracking"; "uncertain", for widely spread particles, several places, or p_lost above 0.1; or "lost",
            if scans or features contradict the pose and p_lost is above 0.5.
        explained: Agreeing share of the explainable beams of the last judged scan, at the mean of the particles; NaN
            without such a scan.
        temperature: Temperature of the first sensor.
        used: Share of the temperature used by the stages of the last correction: below 1 if even the last stage would
            have left too few particles.
        degenerate: True if no particle was possible at the last correction, which then changed nothing.
        particles: Number of particles.
        widening: Factor of the spread in :meth:`protection_level`; 1 without a map, and before the first correction.
        margin: Length added to the radius there [m]; 0 without a map, and before the first correction.
        moments: (3, 3) second moments of the particles about the pose, for the methods "cluster" and "best"; otherwise
            the covariance.
        distances: Distances of the particles from the pose, unless the covariance describes them.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> gs.Estimate(np.zeros(3), np.eye(3) * 0.01, 250.0, 0.02, "tracking", 0.9, 0.1, 1.0, False, 500)
        Estimate(x=0.000, y=0.000, theta=0.000, deviations=(0.1, 0.1, 0.1), p_lost=0.02, verdict='tracking')
    """

    pose: np.ndarray
    covariance: np.ndarray
    effective_sample_size: float
    p_lost: float
    verdict: Word
    explained: float
    temperature: float
    used: float
    degenerate: bool
    particles: int
    widening: float = 1.0
    margin: float = 0.0
    moments: np.ndarray | None = field(default=None, repr=False, compare=False)
    distances: Distances | None = field(default=None, repr=False, compare=False)

    def __repr__(self) -> str:
        x, y, theta = (float(value) for value in self.pose)
        deviations = ", ".join(f"{value:.3g}" for value in np.sqrt(np.maximum(np.diag(self.covariance), 0)))
        return (
            f"Estimate(x={x:.3f}, y={y:.3f}, theta={theta:.3f}, deviations=({deviations}), "
            f"p_lost={self.p_lost:.2g}, verdict={self.verdict!r})"
        )

    def _repr_html_(self) -> str:
        rows = [*pose_rows(self.pose, self.covariance), ("p_lost", self.p_lost, ""), ("explained", self.explained, ""),
                ("effective sample size", self.effective_sample_size, f"of {self.particles}")]  # fmt: skip
        return card(f"Estimate: {self.verdict}", rows, head=("", "value", "deviation"))

    def _moments(self) -> np.ndarray:
        if not self.effective_sample_size >= LEAST_SAMPLE:
            return np.full((3, 3), math.inf)
        return self.covariance if self.moments is None else self.moments


def covariance_of(numbers: np.ndarray) -> np.ndarray:
    """Return the covariance from the results of kernel ``finish_estimate``, without negative variances."""
    xx, xy, xt, yy, yt, tt = numbers[3:9].tolist()
    xx, yy, tt = max(xx, 0.0), max(yy, 0.0), max(tt, 0.0)
    return np.array([[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]])


def sample_size_of(weights: np.ndarray, poses: np.ndarray | None = None) -> float:
    """Return the effective sample size of (N,) weights; equal ones among (N, 3) poses count once."""
    if poses is not None:
        order = np.lexsort(poses.T)
        ordered = poses[order]
        begins = np.flatnonzero(np.append(True, (ordered[1:] != ordered[:-1]).any(axis=1)))
        weights = np.add.reduceat(weights[order], begins)
    return float(weights.sum() ** 2 / (weights @ weights))


def clustered(poses: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and covariance of the heaviest cluster of touching bins, of (N, 3) poses and (N,) weights."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    turns = round(2 * np.pi / _BIN_TURN)
    cells = np.floor(poses[:, :2] / _BIN).astype(np.int64)
    heading = np.floor(wrap_angle(poses[:, 2]) / (2 * np.pi) * turns).astype(np.int64) % turns
    bins, member = np.unique(np.column_stack([cells, heading]), axis=0, return_inverse=True)
    member = member.reshape(-1)
    # Headings are periodic.
    pairs = cKDTree(bins, boxsize=(0, 0, turns)).query_pairs(1.0, p=np.inf, output_type="ndarray")
    rows, columns = pairs.T
    touching = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(len(bins), len(bins)))
    label = connected_components(touching, directed=False)[1][member]
    chosen = label == np.argmax(np.bincount(label, weights))
    w = weights[chosen] / weights[chosen].sum()
    pose = mean_pose(poses[chosen], w)
    d = poses[chosen] - pose
    d[:, 2] = wrap_angle(d[:, 2])
    return pose, (w[:, None] * d).T @ d - np.outer(w @ d, w @ d)
