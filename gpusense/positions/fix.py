"""Result of a position from beacons: solutions, covariance and status."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from gpusense._util.html import card
from gpusense._util.typing import Floats

STATUSES = {
    "unique": "one solution",
    "two": "two circles cross: both points fit equally well",
    "mirror": "the beacons stand in line: the mirror image on the other side of the line fits equally well",
    "ambiguous": "several minima fit within 3 sigma of the best one (their costs differ by less than 9)",
    "tangent": "two circles touch: one point, and no information across the line of their centres",
    "disjoint": "two circles are too far apart to meet: the nearest point between them",
    "contained": "one circle lies inside the other: the nearest point between them",
    "in line": "robot and beacons stand in one line: nothing fixes the position across it (ranges) or along it "
    "(bearings)",
    "coincident": "too few of the beacons stand at different places: a circle, an arc or a ray of solutions remains",
    "parallel": "the lines of sight are parallel: they meet nowhere",
    "behind": "the lines of sight meet where a beacon would lie behind its bearing",
    "circle": "robot and beacons stand on one circle: every point of an arc of it has the same bearings",
    "at a beacon": "the robot stands at a beacon: the bearing to it, and the direction of its range, have no meaning",
    "singular": "the measurements do not fix the position: the information matrix is singular",
}
"""Meaning of each status."""


@dataclass(frozen=True, eq=False)
class PositionFix:
    """Positions or poses that fit measurements of beacons, the best first.

    Attributes:
        solutions: (S, 2) x and y [m], or (S, 3) with theta [rad] in [-pi, pi]; S is 0 if there are none or infinitely
            many.
        covariance: (S, 2, 2) or (S, 3, 3) [m^2, m rad, rad^2] to first order in the noise; NaN if the information
            matrix is singular. Unless sigma is known it assumes sigma = 1: multiply it by the variance.
        residuals: (S, M) measured less expected ranges [m] or bearings [rad, within +-pi]; (S, M, 2) for both.
        cost: (S,) sum of the weighted squared residuals in sigmas, under the loss; chi-squared for the linear loss.
        condition: (S,) condition number of the Jacobian in sigmas, with the heading in units that balance the position;
            1 is best, inf is singular.
        status: One of :data:`gpusense.positions.fix.STATUSES`.
        degenerate: True if the geometry leaves the best solution undetermined: no solution exists, or its information
            matrix is singular.

    Example:
        >>> import gpusense as gs
        >>> fix = gs.trilaterate([(0, 0), (4, 0)], [2.5, 2.5])
        >>> fix.solutions.tolist()
        [[2.0, 1.5], [2.0, -1.5]]
        >>> fix.explain()
        'two: two circles cross: both points fit equally well'
    """

    solutions: Floats
    covariance: Floats
    residuals: Floats
    cost: Floats
    condition: Floats
    status: str
    degenerate: bool

    def __post_init__(self) -> None:
        """Make the arrays read-only."""
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                value.setflags(write=False)

    def __len__(self) -> int:
        return len(self.solutions)

    @property
    def best(self) -> Floats:
        """Solution (2,) or (3,) of the lowest cost.

        Raises:
            ValueError: There is no solution; the message says why.
        """
        if not len(self):
            raise ValueError(f"solutions: must hold one, got none: {self.explain()}")
        best: Floats = self.solutions[0]
        return best

    @property
    def deviation(self) -> Floats:
        """(S,) root of the trace of the position's covariance [m]; the dilution of precision if sigma is 1."""
        return np.sqrt(self.covariance[:, 0, 0] + self.covariance[:, 1, 1])

    def explain(self) -> str:
        """Return the status and its meaning."""
        return f"{self.status}: {STATUSES[self.status]}"

    def _repr_html_(self) -> str:
        names = ("x [m]", "y [m]", "theta [rad]")[: self.solutions.shape[1]]
        rows = [
            (f"solution {k}", *map(float, solution), float(deviation))
            for k, (solution, deviation) in enumerate(zip(self.solutions, self.deviation, strict=True), 1)
        ]
        return card(f"PositionFix: {self.status}", rows, head=("", *names, "deviation [m]"), detail=self.explain())

    def __repr__(self) -> str:
        text = f"PositionFix({self.status!r}, {len(self)} solution{'s' * (len(self) != 1)}"
        if len(self):
            best = ", ".join(f"{value:.6g}" for value in self.solutions[0])
            text += f", best=({best}), deviation={self.deviation[0]:.3g} m"
        return f"{text})"
