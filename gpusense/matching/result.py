"""Result of a scan match: pose, covariance, and whether to trust them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense._util.html import card, pose_rows
from gpusense._util.typing import Floats
from gpusense.matching.observability import covariance_of
from gpusense.world.pose_algebra import composed, rotations

STATUSES = {
    "converged": "the scans agree, and every direction of the pose is observed",
    "unobservable": "the scans agree, but some direction of the pose is not observed, as along a corridor",
    "ambiguous": "another pose agrees about as well; the covariance spans both",
    "doubtful": "the scans agree no better than scans of different places often do: nothing is known about the pose",
    "outside window": "the scans agree best at a pose outside the window: nothing is known about the pose",
    "few points": "too few pairs of points: nothing is known about the pose",
    "no overlap": "the scans see hardly anything in common: nothing is known about the pose",
    "poor": "too much of one scan contradicts the other: nothing is known about the pose",
    "no convergence": "the iterations ended before the steps were small: nothing is known about the pose",
}
"""The meaning of each status."""

USABLE = ("converged", "unobservable", "ambiguous")
"""Statuses of poses that may be used along their observed directions."""


def is_usable(status: str | NDArray[np.str_]) -> NDArray[np.bool]:
    """Return whether statuses are of poses that may be used along their observed directions."""
    if isinstance(status, str):
        return np.bool_(status in USABLE)  # type: ignore[return-value]
    named = np.asarray(status)
    usable = named == USABLE[0]
    for name in USABLE[1:]:
        usable = usable | (named == name)
    return usable


@dataclass(frozen=True, eq=False)
class ScanMatch:
    """The pose of a scan in the frame of an earlier scan or of a map, from :func:`gpusense.match_scan`.

    Fields have a leading axis (S,) for S matches.

    Attributes:
        pose: (3,) x, y [m] and theta [rad, in -pi to pi] of the second scan's robot frame in the reference's robot
            frame, or in the world for a map.
        covariance: (3, 3) of x, y, theta [m^2, m rad, rad^2]; infinite in every coordinate that an unconstrained
            direction involves, and where the match failed.
        information: (3, 3) inverse of the covariance, finite: exactly 0 along directions that nothing constrains, and
            where the match failed. A pose graph adds it unchanged.
        p_right: Probability that the pose is right: off by at most 0.2 m and 5 degrees along its observed directions.
            It assumes that pairs of the same place and of different places are equally frequent.
        score: Share of the points in common sight that agree, 1 at best; points that one scan saw through count
            against it.
        iterations: Iterations of the last refinement.
        eigenvalues: (3,) ascending: the share of pairs of points that constrain each direction of the pose; 0 if none.
        directions: (3, 3) rows: the directions of the eigenvalues in x [m], y [m] and theta, where theta is multiplied
            by ``lever``; their signs are arbitrary.
        lever: Root mean square range of the second scan [m].
        noise: Standard deviation of ranges that was used [m].
        evidence: (E,) numbers from which ``p_right`` is computed, see :data:`gpusense.matching.verdicts.NAMES`.
        status: One of :data:`gpusense.matching.result.STATUSES`; an array of strings for S matches.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> scanner = gs.Scanner.uniform(angle_min=-3.1, angle_increment=0.0175, count=356, range_max=9.0)
        >>> b = scanner.bearings
        >>> room = np.minimum(3 / np.abs(np.cos(b)), 2 / np.abs(np.sin(b)))
        >>> match = gs.match_scan(room, room, scanner, backend="numpy")
        >>> match.status, bool(abs(match.pose).max() < 1e-3)
        ('converged', True)
    """

    pose: Floats
    covariance: Floats
    information: Floats
    p_right: Floats
    score: Floats
    iterations: NDArray[np.int64]
    eigenvalues: Floats
    directions: Floats
    lever: Floats
    noise: Floats
    evidence: Floats
    status: str | NDArray[np.str_]

    @property
    def converged(self) -> NDArray[np.bool]:
        """Return whether the status is ``"converged"``: one pose, observed in every direction. For S matches (S,)."""
        return np.asarray(self.status) == "converged"

    @property
    def usable(self) -> NDArray[np.bool]:
        """Whether the pose may be used along its observed directions, with ``information``. For S matches (S,)."""
        return is_usable(self.status)

    def __len__(self) -> int:
        if self.pose.ndim == 1:
            raise TypeError("a single match has no length")
        return len(self.pose)

    def __getitem__(self, index: int) -> ScanMatch:
        """Return one of S matches."""
        if self.pose.ndim == 1:
            raise TypeError("a single match has no items")
        values = {name: value[index] for name, value in self.__dict__.items()}
        values["status"] = str(values["status"])
        return ScanMatch._of(values)

    @classmethod
    def _of(cls, values: dict[str, Any]) -> ScanMatch:
        """Return a match with all fields by name; the constructor of a frozen class sets each of them by a call."""
        match = object.__new__(cls)
        match.__dict__.update(values)
        return match

    def changed(self, **values: Any) -> ScanMatch:
        """Return matches in which some fields have other values."""
        return ScanMatch._of(self.__dict__ | values)

    @classmethod
    def joined(cls, matches: list[ScanMatch]) -> ScanMatch:
        """Return the matches of several calls as one, in their order; at least one."""
        return cls(*[np.concatenate([getattr(match, name) for match in matches]) for name in _FIELDS])

    def ordered(self, order: NDArray[np.intp]) -> ScanMatch:
        """Return S matches in another order."""
        return ScanMatch(*[np.asarray(getattr(self, name))[order] for name in _FIELDS])

    def moved(self, frame: Floats, reach: tuple[float, float]) -> ScanMatch:
        """Return S matches in the frame in which the reference's robot frames are at (S, 3) poses.

        ``reach`` is the farthest distance [m] and angle [rad] from a guess, see ``covariance_of``.
        """
        pose, turned = composed(frame, self.pose), rotations(frame[:, 2])
        information = turned @ self.information @ turned.transpose(0, 2, 1)
        directions = self.directions @ turned.transpose(0, 2, 1)
        covariance = covariance_of(information, self.lever, reach)
        return self.changed(pose=pose, information=information, covariance=covariance, directions=directions)

    def replaced(self, rows: NDArray[np.intp], others: ScanMatch, chosen: NDArray[np.bool]) -> ScanMatch:
        """Return S matches in which the chosen ones of some rows are replaced by other matches."""
        values = [np.array(getattr(self, name)) for name in _FIELDS]
        for name, value in zip(_FIELDS, values, strict=True):
            value[rows[chosen]] = getattr(others, name)[chosen]
        return ScanMatch(*values)

    def explain(self) -> str:
        """Return the status and its meaning, for one match or counted over many."""
        if isinstance(self.status, str):
            return f"{self.status}: {STATUSES[self.status]}"
        names, counts = np.unique(self.status, return_counts=True)
        return "\n".join(f"{count} {name}: {STATUSES[name]}" for name, count in zip(names, counts, strict=True))

    def _repr_html_(self) -> str:
        if not isinstance(self.status, str):
            return card(f"{len(self)} scan matches", [(line,) for line in self.explain().splitlines()])
        rows = [*pose_rows(self.pose, self.covariance), ("p_right", float(self.p_right), ""),
                ("score", float(self.score), "")]  # fmt: skip
        return card(f"ScanMatch: {self.status}", rows, head=("", "value", "deviation"), detail=self.explain())

    def __repr__(self) -> str:
        if isinstance(self.status, str):
            x, y, theta = self.pose
            return (
                f"ScanMatch({self.status}, x={x:.4g}, y={y:.4g}, theta={theta:.4g}, p_right={float(self.p_right):.3g})"
            )
        return f"ScanMatch({len(self)} matches, {np.count_nonzero(self.converged)} converged)"


# Names of the fields in their order.
_FIELDS = tuple(field.name for field in fields(ScanMatch))
