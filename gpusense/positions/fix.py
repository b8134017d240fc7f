"""Result of a position from beacons, and closed forms that intersect circles and lines of sight, many at once.

From the position p with heading theta, a beacon m has the range d = |m - p| and the bearing b = arg(m - p) - theta.
Points of the plane are complex numbers: a rotation is a product, and formulas are half as long. All lengths are
relative to an origin near the beacons, which the callers subtract.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

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


Complexes = NDArray[np.complex128]
Words = NDArray[np.str_]

EPS = float(np.finfo(np.float64).eps)
# Lengths or sines that differ by at most this number of roundings are equal.
ROUNDINGS = 16


def wrap(angle: Floats) -> Floats:
    """Reduce angles to [-pi, pi]."""
    return np.arctan2(np.sin(angle), np.cos(angle))


def two_circles(
    first: Complexes, second: Complexes, d1: Floats, d2: Floats, share: Floats | float = 0.5, noise: float = 0.0
) -> tuple[Complexes, Words]:
    """Intersect pairs of circles ("Distances Only, No Uncertainty").

    x counts from the beacon with the smaller range, and y is the height of the triangle by Kahan's area
    ("Miscalculating Area and Angles of a Needle-like Triangle", 2014): both keep digits in flat triangles.

    ``share`` of a gap between circles belongs to the first one; ``noise`` is the rounding error of coordinates, a
    length.

    Returns (N, 2) points, beginning with the point to the left of the direction from ``first`` to ``second``; and (N,)
    statuses: "two" (the circles intersect), "tangent", "disjoint", "contained" (one inside the other) or "coincident"
    (one centre). For circles that do not intersect, both points are the nearest point on the line of centres (least
    squares); NaN for one centre.
    """
    base = second - first
    a = np.abs(base)
    swap = d1 > d2
    small, large = np.where(swap, d2, d1), np.where(swap, d1, d2)
    high, middle, low = np.sort(np.stack([a, d1, d2]), axis=0)[::-1]
    slack = low - (high - middle)  # > 0: the three lengths make a triangle
    tolerance = ROUNDINGS * EPS * high + noise
    with np.errstate(divide="ignore", invalid="ignore"):
        x = ((a - large) * (a + large) + small * small) / (2 * a)
        area = (high + (middle + low)) * np.maximum(slack, 0.0) * (low + (high - middle)) * (high + (middle - low))
        y = np.sqrt(area) / (2 * a)
        x = np.where(swap, a - x, x)
        gap = a - d1 - d2
        apart = d1 + gap * share
        # Contained: from the larger circle's centre, the nearest points are beyond the smaller circle's centre.
        inside = np.where(swap, d1 - (d1 - d2 - a) * share, -(d1 + (d2 - d1 - a) * share))
        status = np.where(gap > tolerance, "disjoint", np.where(slack < -tolerance, "contained", "two"))
        status = np.where((status == "two") & (slack <= tolerance), "tangent", status)
        status = np.where(a <= noise, "coincident", status)
        crossing = status == "two"
        # A tangent point is a nearest point: gap and slack are rounding errors.
        x = np.where(crossing, x, np.where(high == a, apart, inside))
        y = np.where(crossing, y, 0.0)
        along = np.where(a > noise, base / a, np.nan)
    return first[:, None] + along[:, None] * (x[:, None] + 1j * np.stack([y, -y], axis=1)), status


def two_rays(first: Complexes, second: Complexes, angle1: Floats, angle2: Floats) -> tuple[Complexes, Floats, Floats]:
    """Intersect pairs of lines of sight of known direction in the world [rad].

    With m_i - p = rho_i u_i, rho_1 = ((m1 - m2) x u2) / (u1 x u2) and rho_2 = ((m1 - m2) x u1) / (u1 x u2).

    Returns (N,) points; (N, 2) distances of the beacons along the lines of sight, negative for a beacon behind the
    robot; and (N,) sines of the angles between the lines. The point of parallel lines is inf or NaN.
    """
    u1, u2 = np.exp(1j * angle1), np.exp(1j * angle2)
    sine = np.sin(angle2 - angle1)
    base = first - second
    with np.errstate(divide="ignore", invalid="ignore"):
        rho = np.stack([(np.conj(base) * u2).imag, (np.conj(base) * u1).imag], axis=1) / sine[:, None]
        nearer_first = np.abs(rho[:, 0]) <= np.abs(rho[:, 1])
        point = np.where(nearer_first, first - rho[:, 0] * u1, second - rho[:, 1] * u2)
    return point, rho, sine


def three_bearings(beacons: Complexes, bearings: Floats) -> tuple[Complexes, Floats, Floats, Floats]:
    """Compute position and heading from (N, 3) bearings of beacons ("Bearings Only").

    (m_i - p) exp(-i (b_i + theta)) is real and positive. Let beacon 2 be the origin: the imaginary parts are three
    linear equations in exp(-i theta) and p exp(-i theta). Eliminating p leaves

        w = sum of m_i exp(-i b_i) sin(b_j - b_k) over the cyclic (i, j, k),   exp(i theta) = +-w / |w|,

    and the two lines of sight with the largest angle between them determine the position. Unlike laws of cosines or
    cotangents (Pierlot and Van Droogenbroeck, "A New Three Object Triangulation Algorithm for Mobile Robot
    Positioning", 2014) this form needs no special cases for beacons in line, or for a robot in line with two beacons. w
    = 0 on the circle through the beacons.

    Returns (N,) positions; (N,) headings; (N, 3) distances along the lines of sight, all > 0 for a valid pose; and (N,)
    clarities: |w| relative to the sum of its terms' magnitudes, 0 if the bearings leave more than one pose.
    """
    terms = np.empty(beacons.shape, np.complex128)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        # The sum is independent of the origin; the middle of the beacons keeps most digits.
        terms[:, i] = (beacons[:, i] - beacons.mean(axis=1)) * np.exp(-1j * bearings[:, i])
        terms[:, i] *= np.sin(bearings[:, j] - bearings[:, k])
    w, size = terms.sum(axis=1), np.abs(terms).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        clarity = np.where(size > 0, np.abs(w) / size, 0.0)
    heading = np.angle(w)
    angle = bearings + heading[:, None]
    pairs = np.array([(0, 1), (1, 2), (2, 0)])
    sines = np.abs(np.sin(bearings[:, pairs[:, 0]] - bearings[:, pairs[:, 1]]))
    row = np.arange(len(beacons))
    i, j = pairs[np.argmax(sines, axis=1)].T
    point, _, _ = two_rays(beacons[row, i], beacons[row, j], angle[row, i], angle[row, j])
    with np.errstate(invalid="ignore"):
        rho = ((beacons - point[:, None]) * np.exp(-1j * angle)).real
    # A turn by pi changes the signs of all distances, but not the position.
    turned = np.nansum(np.sign(rho), axis=1) < 0
    heading = np.where(turned, heading + np.pi, heading)
    return point, wrap(heading), np.where(turned[:, None], -rho, rho), clarity
