"""Triangulate: compute a position, or a pose, from bearings of beacons."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util import checks
from gpusense._util.typing import Floats, Loss
from gpusense.positions.fix import EPS, ROUNDINGS, PositionFix, three_bearings, two_rays
from gpusense.positions.problem import Problem, make_problem, subsets
from gpusense.positions.solver import in_line, solve


def triangulate(
    xy: ArrayLike,
    bearings: ArrayLike,
    heading: float | None = None,
    *,
    sigma: ArrayLike | None = None,
    weights: ArrayLike | None = None,
    loss: Loss = "linear",
    loss_scale: float = 1.0,
) -> PositionFix:
    """Compute the position, and the heading if it is unknown, from bearings of beacons.

    If the heading is known, two beacons suffice: their lines of sight intersect in closed form. Otherwise three
    suffice, see :func:`triangulate_triangle`. More beacons determine the global minimum of ``sum of rho(weight
    (residual / sigma)^2)``: Gauss-Newton steps start from linear solutions and from closed forms of pairs or triples.
    Lines of sight are rays: a beacon behind its bearing is no solution. If ``sigma`` is known, all minima are returned
    that the noise cannot distinguish from the best.

    A call takes one set of measurements. Coordinates may be as large as in UTM.

    Args:
        xy: (M, 2) positions of the beacons [m].
        bearings: (M,) directions to the beacons in the robot's frame, counter-clockwise from straight ahead [rad], any
            real numbers.
        heading: The robot's heading in the world [rad], or None if unknown.
        sigma: Standard deviation of the bearings [rad], one or (M,), > 0. None if unknown: the covariance
            then assumes 1 rad; multiply it by the variance.
        weights: (M,) factors >= 0 of the squared residuals; 0 ignores a beacon. The default is 1.
        loss: "linear", "soft_l1", "huber", "cauchy" or "arctan", as in ``scipy.optimize.least_squares``. It has no
            effect without redundant bearings.
        loss_scale: Residual at which a robust loss bends [sigma, or rad without sigma], > 0.

    Returns:
        Positions (S, 2) for a known heading, else poses (S, 3). Statuses: "unique", "ambiguous", "at a beacon",
        "singular"; without solutions "parallel", "in line", "coincident", "circle" and "behind". For more bearings
        than unknowns, "behind" has a solution.

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: A shape or value breaks its rule, or too few beacons are left.

    Source: lectures, "Bearings Only"; Thrun, Burgard and Fox, *Probabilistic Robotics*, section 6.6.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> fix = gs.triangulate([(4, 1), (2, 3), (0, 1)], np.radians([0, 90, 180]), heading=0.0, sigma=0.01)
        >>> fix.status, fix.best.round(6).tolist()
        ('unique', [2.0, 1.0])
    """
    least, remainder = (3, "an arc") if heading is None else (2, "a ray")
    problem = make_problem(
        xy, bearings=checks.array("bearings", bearings), heading=heading, sigma_bearing=sigma, weights=weights,
        loss=loss, loss_scale=loss_scale, least=least, reason=f", or {remainder} of solutions remains",
    )  # fmt: skip
    status = _no_solution(problem)
    if status:
        return problem.fix([], status)
    sets = subsets(len(problem.xy), least)
    starts, rho, clarity = _rays(problem, sets) if heading is not None else _triples(problem, sets)
    if heading is None and not (clarity > _triple_blur(problem, sets)).any():
        return problem.fix([], _line_or_circle(problem))
    if len(problem.xy) == least:
        # Without redundant bearings, the closed form is the solution.
        status = "at a beacon" if problem.at_beacon(starts[0]) else "behind" if rho[0].min() < 0 else "unique"
        return _on_circle(problem, sets, clarity, problem.fix([] if status == "behind" else starts, status))
    linear = _nearest_point(problem) if heading is not None else _linear_pose(problem)
    states, status = solve(problem, np.vstack([linear, starts]), known_sigma=sigma is not None)
    if status == "unique" and np.abs(problem.residuals(states[:1])).max() > np.pi / 2:
        status = "behind"
    return _on_circle(problem, sets, clarity, problem.fix(states, status))


def triangulate_triangle(xy: ArrayLike, bearings: ArrayLike, *, sigma: ArrayLike | None = None) -> PositionFix:
    """Compute position and heading from the bearings of exactly three beacons, in closed form.

    The lectures solve the triangles robot-beacon-beacon by the law of cosines, D_ij^2 = z_i^2 + z_j^2 - 2 z_i z_j
    cos(b_j - b_i). This function solves linear equations for the same pose, without iterations or special cases for
    beacons in line: see :func:`gpusense.positions.fix.three_bearings`.

    Args:
        xy: (3, 2) positions of the beacons [m].
        bearings: (3,) directions to the beacons in the robot's frame, counter-clockwise from straight ahead [rad], any
            real numbers.
        sigma: Standard deviation of the bearings [rad], one or (3,), > 0. None if unknown: the covariance
            then assumes 1 rad; multiply it by the variance.

    Returns:
        One pose (1, 3) with status "unique" or "at a beacon", or no pose with status "circle", "in line", "coincident"
        or "behind".

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: A shape or value breaks its rule.

    Source: lectures, "Bearings Only".

    Example:
        >>> import gpusense as gs, numpy as np
        >>> gs.triangulate_triangle([(5, 3), (3, 5), (1, 3)], np.radians([-90, 0, 90])).best.round(3).tolist()
        [3.0, 3.0, 1.571]
    """
    beacons = checks.array("xy", xy, ("M", 2))
    if len(beacons) != 3:
        raise ValueError(f"xy: must hold exactly 3 beacons, got {len(beacons)}")
    return triangulate(beacons, bearings, sigma=sigma)


def _angle_rounding(problem: Problem) -> float:
    """Return the rounding error of the bearings, which may be reduced by whole turns."""
    return EPS * (4 * ROUNDINGS + float(np.abs(problem.bearings).max()))


def _triple_blur(problem: Problem, triples: NDArray[np.intp], state: Floats | None = None) -> Floats:
    """Return the (N,) rounding errors of the clarity of triples, see :func:`three_bearings`.

    The error of an angle, times |m_i| cos(b_j - b_k), changes the terms m_i exp(-i b_i) sin(b_j - b_k). For beacons in
    nearly one direction this exceeds the terms. Rounded coordinates affect the direction to a near beacon most; None as
    ``state`` assumes a robot at the beacons' distance from each other.
    """
    points, bearings = problem.points[triples], problem.bearings[triples]
    away = np.abs(points - points.mean(axis=1, keepdims=True))
    angle = bearings[:, [1, 2, 0]] - bearings[:, [2, 0, 1]]
    sines = np.abs(np.sin(angle))
    size = np.sum(away * sines, axis=1)
    far = np.full(len(problem.xy), problem.spread) if state is None else np.hypot(*(problem.xy - state[:2]).T)
    blur = (_angle_rounding(problem) + 2 * problem.noise / np.maximum(far, problem.touch))[triples]
    both = blur[:, [1, 2, 0]] + blur[:, [2, 0, 1]]
    error = np.sum(away * (sines * blur + np.abs(np.cos(angle)) * both), axis=1)
    error += 2 * problem.noise * np.sum(sines, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(size > 0, error / size, np.inf)


def _line_or_circle(problem: Problem) -> str:
    return "in line" if in_line(problem.xy, problem.noise) else "circle"


def _on_circle(problem: Problem, triples: NDArray[np.intp], clarity: Floats, fix: PositionFix) -> PositionFix:
    """Return ``fix``, empty where beacons and robot share a circle, whose bearings have a singular Jacobian."""
    if problem.heading is not None or fix.status not in ("singular", "unique"):
        return fix
    if fix.status == "unique" and (clarity > _triple_blur(problem, triples, fix.best[:2] - problem.origin)).any():
        return fix
    return problem.fix([], _line_or_circle(problem))


def _no_solution(problem: Problem) -> str:
    """Return the status of beacons or lines of sight that determine no point or infinitely many, else ""."""
    places = np.unique(problem.xy, axis=0)
    if len(places) == 1 or (problem.heading is None and len(places) == 2):
        return "coincident"
    turned = problem.bearings - problem.bearings[0]
    # Rounding error of a zero angle between lines of sight.
    if np.abs(np.sin(turned)).max() > _angle_rounding(problem) + 2 * problem.noise / problem.spread:
        return ""
    # All lines of sight are parallel, and may coincide.
    line = in_line(problem.xy, problem.noise)
    if problem.heading is None:
        return "behind" if line is None else "in line"
    angle = problem.bearings[0] + problem.heading
    aside = (problem.xy - problem.xy[0]) @ (-np.sin(angle), np.cos(angle))
    rounding = 8 * problem.noise + (_angle_rounding(problem) + EPS * abs(problem.heading)) * problem.spread
    return "in line" if np.abs(aside).max() <= rounding else "parallel"


def _rays(problem: Problem, pairs: NDArray[np.intp]) -> tuple[Floats, Floats, Floats]:
    """Intersect pairs of lines of sight: (N, 2) points, (N, 2) distances and (N,) sines."""
    assert problem.heading is not None
    angle, (i, j) = problem.bearings + problem.heading, pairs.T
    point, rho, sine = two_rays(problem.points[i], problem.points[j], angle[i], angle[j])
    return np.column_stack([point.real, point.imag]), rho, np.abs(sine)


def _triples(problem: Problem, triples: NDArray[np.intp]) -> tuple[Floats, Floats, Floats]:
    """Solve triples of beacons: (N, 3) poses, (N, 3) distances, and (N,) clarities of the poses."""
    point, heading, rho, clarity = three_bearings(problem.points[triples], problem.bearings[triples])
    return np.column_stack([point.real, point.imag, heading]), rho, clarity


def _nearest_point(problem: Problem) -> Floats:
    """Return (1, 2) the point nearest to all lines of sight, the minimum of sum of s_i^2 (n_i (p - m_i))^2."""
    assert problem.heading is not None
    angle = problem.bearings + problem.heading
    normal = np.stack([-np.sin(angle), np.cos(angle)], axis=1) * problem.scales[:, None]
    return np.linalg.lstsq(normal, np.sum(normal * problem.xy, axis=1), rcond=None)[0][None]


def _linear_pose(problem: Problem) -> Floats:
    """Return (2, 3) poses of opposite headings, by Im((m_i q - s) exp(-i b_i)) = 0 with q = exp(-i theta), s = p q.

    The equations are linear and homogeneous in q and s; the right singular vector of the least singular value solves
    them in least squares.
    """
    turn, length = np.exp(-1j * problem.bearings), problem.spread
    seen = problem.points / length * turn
    rows = np.column_stack([seen.imag, seen.real, -turn.imag, -turn.real]) * problem.scales[:, None]
    a, b, c, d = np.linalg.svd(rows)[2][-1]
    q, s = complex(a, b), complex(c, d)
    if q == 0:
        return np.empty((0, 3))
    point, theta = s / q * length, -np.angle(q)
    return np.array([(point.real, point.imag, theta), (point.real, point.imag, theta + np.pi)])
