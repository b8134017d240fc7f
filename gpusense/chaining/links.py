"""Links of a pose graph, poses of scans in the frames of other scans with information, and motion between scans."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from gpusense._util.angles import wrapped
from gpusense._util.typing import Flags, Floats, Integers
from gpusense.localization.motion import OdometryMotion, turns_between
from gpusense.localization.motion_fit import fit_odometry_motion
from gpusense.world.deskew import part_of_arc
from gpusense.world.pose_algebra import pose_difference, wrap_angle

MATCH, ODOMETRY, MOTION, COUPLING, CLOSURE = "match", "odometry", "motion", "coupling", "closure"
KINDS = {
    MATCH: "scans near each other in the log, matched",
    ODOMETRY: "the robot's odometry",
    MOTION: "constant motion, where scans and odometry leave a direction open",
    COUPLING: "scans of two scanners of the robot, by the motion between them",
    CLOSURE: "scans of a place that was seen again, matched",
}
"""Meaning of each kind of link."""


@dataclass(frozen=True, eq=False)
class Links:
    """L links between scans.

    Example:
        >>> import numpy as np
        >>> from gpusense.chaining.links import Links
        >>> len(Links.of("odometry", [0], [1], np.zeros((1, 3)), np.eye(3)[None]))
        1
    """

    first: Integers  # (L,) indices of the scans that are frames of reference
    second: Integers  # (L,) indices of the scans at these poses
    pose: Floats  # (L, 3) poses of the second scans in the frames of the first ones [m, m, rad]
    information: Floats  # (L, 3, 3) inverse covariances, 0 along directions that are not observed
    p_right: Floats  # (L,) probabilities that the poses are right; NaN for odometry and constant motion
    kind: NDArray[np.str_]  # (L,) kinds, see :data:`gpusense.chaining.links.KINDS`
    weight: Floats  # (L,) factors of the information in the solution: near 0 for links that all others contradict

    @classmethod
    def of(
        cls, kind: str, first: object, second: object, pose: Floats, information: Floats, p_right: object = np.nan
    ) -> Links:
        """Return links of one kind with weight 1."""
        count = len(pose)
        return cls(
            np.asarray(first, np.int64).reshape(count), np.asarray(second, np.int64).reshape(count),
            np.asarray(pose, np.float64).reshape(count, 3), np.asarray(information, np.float64).reshape(count, 3, 3),
            np.array(np.broadcast_to(np.asarray(p_right, np.float64), count)), np.full(count, kind, "<U8"),
            np.ones(count),
        )  # fmt: skip

    @classmethod
    def joined(cls, parts: Sequence[Links]) -> Links:
        """Join the links of several parts in order."""
        if not parts:
            return cls.of(MATCH, [], [], np.zeros((0, 3)), np.zeros((0, 3, 3)))
        return cls(**{f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)})

    def __len__(self) -> int:
        return len(self.first)

    def __getitem__(self, chosen: NDArray[np.bool] | Integers | slice) -> Links:
        """Return some of the links."""
        return Links(**{field.name: getattr(self, field.name)[chosen] for field in fields(self)})

    def renumbered(self, numbers: Integers) -> Links:
        """Return the links with scans renumbered by ``numbers``."""
        return replace(self, first=numbers[self.first], second=numbers[self.second])

    def residuals(self, poses: Floats) -> Floats:
        """Return (L, 3) differences between the relative poses of (N, 3) poses and the links' poses."""
        cos, sin = np.cos(poses[:, 2])[self.first], np.sin(poses[:, 2])[self.first]
        x, y, turn = (poses[self.second] - poses[self.first]).T
        off = np.stack([cos * x + sin * y, cos * y - sin * x, turn], axis=1) - self.pose
        off[:, 2] = wrapped(off[:, 2])
        return off

    def squared(self, residuals: Floats) -> Floats:
        """Return (L,) squared distances of (L, 3) residuals in deviations."""
        squared: Floats = np.einsum("li,lij,lj->l", residuals, self.information, residuals)
        return np.maximum(squared, 0.0)


def chained(first: Floats, steps: Floats) -> Floats:
    """Return (S + 1, 3) poses: the first, then a pose after each of the (S, 3) steps."""
    heading = np.cumsum(np.append(first[2], steps[:, 2]))
    c, s = np.cos(heading[:-1]), np.sin(heading[:-1])
    x = np.cumsum(np.append(first[0], c * steps[:, 0] - s * steps[:, 1]))
    y = np.cumsum(np.append(first[1], s * steps[:, 0] + c * steps[:, 1]))
    return np.stack([x, y, wrapped(heading)], axis=1)


def runs_of(flags: Flags) -> tuple[Integers, Integers]:
    """Return the first places (R,) of runs of true flags, and the places behind their last ones."""
    edges = np.diff(np.concatenate([[False], flags, [False]]).astype(int))
    return np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)


# Least deviations of a motion by odometry [m, rad], for finite information.
_LEAST = (1e-3, 5e-4)
# Most steps in a fit of an odometer's noise.
_MOST_STEPS = 1000
# Deviations of constant motion: a share of the motion, and an amount per scan [m, rad].
_SHARE, _RESTLESS, _RESTLESS_TURN = 0.5, 0.02, 0.02


def odometry_links(motion: OdometryMotion, before: Floats, after: Floats) -> tuple[Floats, Floats]:
    """Return the motions (L, 3) between poses of an odometer without its systematic errors, and their information."""
    count = len(before)
    poses, covariances = np.zeros((count, 3)), np.zeros((count, 3, 3))
    for k in range(count):
        sampled = motion.sampled_turns(*turns_between(before[k], after[k]))
        first, ahead, _, _ = sampled.mean
        c, s = math.cos(first), math.sin(first)
        poses[k] = sampled.after((0.0, 0.0, 0.0))
        jacobian = np.array([[-s * ahead, c, -s, 0.0], [c * ahead, s, c, 0.0], [1.0, 0.0, 0.0, 1.0]])
        covariances[k] = jacobian * np.square(sampled.deviation) @ jacobian.T
    covariances += np.diag([_LEAST[0] ** 2, _LEAST[0] ** 2, _LEAST[1] ** 2])
    information: Floats = np.asarray(np.linalg.inv(covariances), np.float64)
    return poses, information


def fitted_motion(odometry: Floats, poses: Floats, joined: NDArray[np.bool]) -> OdometryMotion:
    """Fit an odometer's noise to poses (M, 3), at motions ``joined`` (M - 1,) by full matches, if there are enough."""
    # Use the longest stretch without a gap.
    ends = np.flatnonzero(~np.concatenate([[False], joined, [False]]))
    longest = int(np.argmax(np.diff(ends)))
    part = slice(ends[longest], min(ends[longest + 1], ends[longest] + _MOST_STEPS))
    if part.stop - part.start < 3:
        return OdometryMotion()
    try:
        return fit_odometry_motion(odometry[part], poses[part]).motion
    except ValueError:  # the robot hardly moved
        return OdometryMotion()


def constant_motion_deviation(steps: Floats) -> Floats:
    """Return the deviations (L, 2) of motions (L, 3) copied from the previous step [m, rad]."""
    length = np.hypot(steps[:, 0], steps[:, 1])
    return np.stack([_RESTLESS + _SHARE * length, _RESTLESS_TURN + _SHARE * np.abs(steps[:, 2])], axis=1)


def scan_motions(steps: Floats, times: Floats, duration: float) -> Floats:
    """Return the motions (S, 3) during scans of a duration [s] by the mean velocity before and after each."""
    gaps = np.diff(times)
    velocity = np.where(gaps[:, None] > 0, steps / np.where(gaps > 0, gaps, 1.0)[:, None], 0.0)
    if not len(velocity):
        return np.zeros((len(times), 3))
    both = np.concatenate([velocity[:1], velocity, velocity[-1:]])
    return 0.5 * duration * (both[:-1] + both[1:])


def relative(poses: Floats, first: NDArray[np.int64], second: NDArray[np.int64]) -> Floats:
    """Return (L, 3) poses of second scans in the frames of first ones."""
    found: Floats = pose_difference(poses[first], poses[second])
    return found


def partial_motion(motion: Floats, share: Floats) -> Floats:
    """Return the motions (L, 3) after a share (L,) of full motions along arcs."""
    return np.stack(part_of_arc(motion, share), axis=1)


def filled_motion(motion: Floats, expected: Floats, unseen: Floats) -> Floats:
    """Replace the part of a motion (3,) in a projection's (3, 3) range by the expected motion."""
    off = expected - motion
    off[2] = wrap_angle(off[2])
    result: Floats = motion + unseen @ off
    return result
