"""Result of a scan match: pose, covariance, and whether to trust them."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

STATUSES = {
    "converged": "the scans agree, and every direction of the pose is observed",
    "unobservable": "the scans agree, but some direction of the pose is not observed, as along a corridor",
    "ambiguous": "another pose agrees about as well; the covariance spans both",
    "few points": "too few pairs of points: nothing is known about the pose",
    "no overlap": "the scans see hardly anything in common: nothing is known about the pose",
    "poor": "too much of one scan contradicts the other: nothing is known about the pose",
    "no convergence": "the iterations ended before the steps were small: nothing is known about the pose",
}
"""The meaning of each status."""


@dataclass(frozen=True, eq=False)
class ScanMatch:
    """The pose of a scan in the frame of an earlier scan or of a map, from :func:`gpusense.match_scan`.

    Fields have a leading axis (S,) for S matches.

    Attributes:
        pose: (3,) x, y [m] and theta [rad, in -pi to pi] of the second scan's robot frame in the reference's robot
            frame, or in the world for a map.
        covariance: (3, 3) of x, y, theta [m^2, m rad, rad^2]; infinite along directions that nothing constrains, and
            where the match failed.
        score: Share of the points in common sight that agree, 1 at best; points that one scan saw through count
            against it.
        iterations: Iterations of the last refinement.
        converged: Whether the pose may be used along its observed directions.
        eigenvalues: (3,) ascending: the share of pairs of points that constrain each direction of the pose; 0 if none.
        directions: (3, 3) rows: the directions of the eigenvalues in x [m], y [m] and theta, where theta is multiplied
            by ``lever``.
        lever: Root mean square range of the second scan [m].
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
    score: Floats
    iterations: NDArray[np.int64]
    converged: NDArray[np.bool]
    eigenvalues: Floats
    directions: Floats
    lever: Floats
    status: str | NDArray[np.str_]

    def __len__(self) -> int:
        if self.pose.ndim == 1:
            raise TypeError("a single match has no length")
        return len(self.pose)

    def __getitem__(self, index: int) -> ScanMatch:
        """Return one of S matches."""
        if self.pose.ndim == 1:
            raise TypeError("a single match has no items")
        values = {field.name: getattr(self, field.name)[index] for field in fields(self)}
        return ScanMatch(**values | {"status": str(values["status"])})

    def explain(self) -> str:
        """Return status and its meaning, for one match or counted over many."""
        if isinstance(self.status, str):
            return f"{self.status}: {STATUSES[self.status]}"
        names, counts = np.unique(self.status, return_counts=True)
        return "\n".join(f"{count} {name}: {STATUSES[name]}" for name, count in zip(names, counts, strict=True))

    def __repr__(self) -> str:
        if isinstance(self.status, str):
            x, y, theta = self.pose
            return f"ScanMatch({self.status}, x={x:.4g}, y={y:.4g}, theta={theta:.4g}, score={float(self.score):.3g})"
        return f"ScanMatch({len(self)} matches, {np.count_nonzero(self.converged)} converged)"
