"""Links of a pose graph: poses of scans in the frames of other scans, with information."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from gpusense._util.angles import wrapped
from gpusense._util.typing import Floats, Integers

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
