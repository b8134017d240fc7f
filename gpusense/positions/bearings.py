"""A position, with or without the heading, from bearings of beacons."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense.positions.closed_forms import EPS, ROUNDINGS, three_bearings, two_rays
from gpusense.positions.fix import PositionFix
from gpusense.positions.problem import Floats, Problem, make_problem, subsets
from gpusense.positions.solver import in_line, minima, pick


def triangulate(
    xy: ArrayLike,
    bearings: ArrayLike,
    heading: float | None = None,
    *,
    sigma: ArrayLike | None = None,
    weights: ArrayLike | None = None,
    loss: str = "linear",
    loss_scale: float = 1.0,
) -> PositionFix:
    """The position, and the heading where it is not known, that sees beacons at the bearings measured.

    With a known heading two beacons are enough: their lines of sight cross in closed form. Without it three are, see
    :func:`triangulate_triangle`. More beacons: the global minimum of ``sum of rho(weight (residual / sigma)^2)``, by
    Gauss-Newton steps from linear solutions and from the closed forms of pairs or triples. Lines of sight are rays: a
    beacon behind its bearing is no solution. With ``sigma``, all minima that the noise cannot tell from the best are
    returned.

    One measurement set a call; coordinates may be as large as UTM's.

    Args:
        xy: (M, 2) the beacons' x and y [m].
        bearings: (M,) directions to them in the robot's frame, counter-clockwise from straight ahead [rad], any real.
        heading: The robot's heading in the world [rad], or None: it is looked for.
        sigma: Standard deviation of the bearings [rad], one or (M,), > 0. None: not known; then the covariance is that
            of sigma = 1 rad, to be multiplied with the variance.
        weights: (M,) factors >= 0 of the squared residuals; 0 leaves a beacon out. By default 1.
        loss: "linear", "soft_l1", "huber", "cauchy" or "arctan", as in ``scipy.optimize.least_squares``. It is not
            used where there are only as many bearings as unknowns.
        loss_scale: Residual at which a robust loss bends [sigma, or rad where sigma is not given], > 0.

    Returns:
        Positions (S, 2) for a known heading, else poses (S, 3). Statuses: "unique", "ambiguous", "parallel", "in line",
        "coincident", "behind" and "circle" (without solutions but for "behind" of more bearings than unknowns),
        "at a beacon", "singular".

    Raises:
        TypeError: an argument is not of the kind described.
        ValueError: a shape or value breaks its rule, or too few beacons are left.

    Source: lectures, "Bearings Only"; Thrun, Burgard and Fox, *Probabilistic Robotics*, section 6.6.
    """
    least, left = (3, "an arc") if heading is None else (2, "a ray")
    problem = make_problem(
        xy, bearings=bearings, heading=heading, sigma_bearing=sigma, weights=weights, loss=loss, loss_scale=loss_scale,
        least=least, reason=f", or {left} of solutions remains",
    )  # fmt: skip
    word = _no_solution(problem)
    if word:
        return problem.fix([], word)
    chosen = subsets(len(problem.xy), least)
    starts, rho, clarity = _rays(problem, chosen) if heading is not None else _triples(problem, chosen)
    if len(problem.xy) == least:
        return _exact(problem, starts, rho[0], clarity[0])
    if heading is None and not (clarity > _blur(problem)).any():
        return problem.fix([], "circle")
    linear = _nearest_point(problem) if heading is not None else _linear_pose(problem)
    states, status = pick(*minima(problem, np.vstack([linear, starts])), told=sigma is not None)
    if problem.at_beacon(states[0]):
        status = "at a beacon"
    elif status == "unique" and np.abs(problem.residuals(states[:1])).max() > np.pi / 2:
        status = "behind"
    return problem.fix(states, status)


def triangulate_triangle(xy: ArrayLike, bearings: ArrayLike, *, sigma: ArrayLike | None = None) -> PositionFix:
    """Position and heading from the bearings of exactly three beacons, in closed form.

    The lectures solve the triangles robot-beacon-beacon by the law of cosines, D_ij^2 = z_i^2 + z_j^2 - 2 z_i z_j cos
    (b_j - b_i). The same pose comes out here from linear equations, without iterations and without special cases for
    beacons in line: see :func:`gpusense.positions.closed_forms.three_bearings`.

    Args:
        xy: (3, 2) the beacons' x and y [m].
        bearings: (3,) directions to them in the robot's frame, counter-clockwise from straight ahead [rad], any real.
        sigma: Standard deviation of the bearings [rad], one or (3,), > 0. None: not known; then the covariance is that
            of sigma = 1 rad, to be multiplied with the variance.

    Returns:
        One pose (1, 3), or none: "unique", "at a beacon"; without solutions "circle", "in line", "coincident",
        "behind".

    Raises:
        TypeError: an argument is not of the kind described.
        ValueError: a shape or value breaks its rule.

    Source: lectures, "Bearings Only".
    """
    problem = make_problem(xy, bearings=bearings, sigma_bearing=sigma)
    if len(problem.xy) != 3:
        raise ValueError(f"xy: must hold exactly 3 beacons, got {len(problem.xy)}")
    word = _no_solution(problem)
    if word:
        return problem.fix([], word)
    states, rho, clarity = _triples(problem, np.array([[0, 1, 2]]))
    return _exact(problem, states, rho[0], clarity[0])


def _angle_rounding(problem: Problem) -> float:
    """Rounding of the bearings, which were often reduced by whole turns or are differences of larger angles."""
    assert problem.bearings is not None
    return EPS * (4 * ROUNDINGS + float(np.abs(problem.bearings).max()))


def _blur(problem: Problem) -> float:
    """Rounding of the angles between lines of sight, and of |w| in :func:`three_bearings`, where they should be 0."""
    return _angle_rounding(problem) + 2 * problem.noise / problem.spread


def _no_solution(problem: Problem) -> str:
    """The status where beacons or lines of sight leave no point or too many, "" elsewhere."""
    assert problem.bearings is not None
    places = np.unique(problem.xy, axis=0)
    if len(places) == 1 or (problem.heading is None and len(places) == 2):
        return "coincident"
    turned = problem.bearings - problem.bearings[0]
    if np.abs(np.sin(turned)).max() > _blur(problem):
        return ""
    # All lines of sight are parallel. They may be one and the same.
    line = in_line(problem.xy, problem.noise)
    if problem.heading is None:
        return "behind" if line is None else "in line"
    angle = problem.bearings[0] + problem.heading
    aside = (problem.xy - problem.xy[0]) @ (-np.sin(angle), np.cos(angle))
    rounding = 8 * problem.noise + (_angle_rounding(problem) + EPS * abs(problem.heading)) * problem.spread
    return "in line" if np.abs(aside).max() <= rounding else "parallel"


def _rays(problem: Problem, pairs: NDArray[np.intp]) -> tuple[Floats, Floats, Floats]:
    """Where pairs of lines of sight cross: (N, 2), distances (N, 2) and sines (N,)."""
    assert problem.bearings is not None and problem.heading is not None
    angle, (i, j) = problem.bearings + problem.heading, pairs.T
    point, rho, sine = two_rays(problem.points[i], problem.points[j], angle[i], angle[j])
    return np.column_stack([point.real, point.imag]), rho, np.abs(sine)


def _triples(problem: Problem, triples: NDArray[np.intp]) -> tuple[Floats, Floats, Floats]:
    """The poses of triples of beacons: (N, 3), distances (N, 3), and how clear they are (N,)."""
    assert problem.bearings is not None
    point, heading, rho, clarity = three_bearings(problem.points[triples], problem.bearings[triples])
    return np.column_stack([point.real, point.imag, heading]), rho, clarity


def _exact(problem: Problem, states: Floats, rho: Floats, clarity: float) -> PositionFix:
    """As many bearings as unknowns: the closed form's solution, if it is one."""
    if problem.heading is None and clarity <= _blur(problem):
        return problem.fix([], "in line" if in_line(problem.xy, problem.noise) else "circle")
    if problem.at_beacon(states[0]):
        return problem.fix(states, "at a beacon")
    return problem.fix([], "behind") if rho.min() < 0 else problem.fix(states, "unique")


def _nearest_point(problem: Problem) -> Floats:
    """(1, 2) the point nearest to all lines of sight: sum of s_i^2 (n_i (p - m_i))^2 is least."""
    assert problem.bearings is not None and problem.heading is not None
    angle = problem.bearings + problem.heading
    normal = np.stack([-np.sin(angle), np.cos(angle)], axis=1) * problem.scales[:, None]
    return np.linalg.lstsq(normal, np.sum(normal * problem.xy, axis=1), rcond=None)[0][None]


def _linear_pose(problem: Problem) -> Floats:
    """(2, 3) poses, opposite in heading, from Im((m_i q - s) exp(-i b_i)) = 0 with q = exp(-i theta), s = p q.

    The equations are linear and homogeneous in q and s; the right singular vector of the least singular value solves
    them in least squares.
    """
    assert problem.bearings is not None
    turn, length = np.exp(-1j * problem.bearings), problem.spread
    seen = problem.points / length * turn
    rows = np.column_stack([seen.imag, seen.real, -turn.imag, -turn.real]) * problem.scales[:, None]
    a, b, c, d = np.linalg.svd(rows)[2][-1]
    q, s = complex(a, b), complex(c, d)
    if q == 0:
        return np.empty((0, 3))
    point, theta = s / q * length, -np.angle(q)
    return np.array([(point.real, point.imag, theta), (point.real, point.imag, theta + np.pi)])
