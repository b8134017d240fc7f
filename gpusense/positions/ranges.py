"""Compute a position from distances to beacons, and a pose from ranges and bearings of beacons."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util import checks
from gpusense._util.angles import wrapped
from gpusense._util.typing import Floats, Loss
from gpusense.positions.fix import PositionFix, two_circles, wrap
from gpusense.positions.problem import Problem, make_problem, subsets
from gpusense.positions.solver import distinct, in_line, minima, pick, solve


def trilaterate(
    xy: ArrayLike,
    ranges: ArrayLike,
    *,
    sigma: ArrayLike | None = None,
    weights: ArrayLike | None = None,
    loss: Loss = "linear",
    loss_scale: float = 1.0,
) -> PositionFix:
    """Compute the position from distances to beacons.

    For two beacons the solutions are both intersections of their circles, in closed form, or the least-squares point
    between circles that do not intersect. Three or more beacons determine the global minimum of ``sum of rho(weight
    (residual / sigma)^2)``: Gauss-Newton steps start from the linearised solution and from the intersections of pairs
    of circles. For beacons in line the mirror image is the second solution. If ``sigma`` is known, all minima are
    returned that the noise cannot distinguish from the best.

    A call takes one set of measurements. Coordinates may be as large as in UTM.

    Args:
        xy: (M, 2) positions of the beacons [m], M >= 2.
        ranges: (M,) measured distances [m], >= 0.
        sigma: Standard deviation of the ranges [m], one or (M,), > 0. None if unknown: the covariance then assumes 1
            m; multiply it by the variance.
        weights: (M,) factors >= 0 of the squared residuals; 0 ignores a beacon. The default is 1.
        loss: "linear" (least squares), "soft_l1", "huber", "cauchy" or "arctan", as in
            ``scipy.optimize.least_squares``. It is ignored for two beacons, which cannot show an outlier.
        loss_scale: Residual at which a robust loss bends [sigma, or m without sigma], > 0.

    Returns:
        Positions (S, 2). Statuses: "unique", "two", "mirror", "ambiguous", "tangent", "disjoint", "contained",
        "in line", "coincident" (no solution), "at a beacon", "singular".

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: A shape or value breaks its rule, or fewer than two beacons remain, with a circle of solutions.

    Source: lectures, "Distances Only, No Uncertainty"; Thrun, Burgard and Fox, *Probabilistic Robotics*, section 6.6.

    Example:
        >>> import gpusense as gs
        >>> fix = gs.trilaterate([(0, 0), (4, 0), (0, 3)], [2.5, 2.5, 2.5], sigma=0.1)
        >>> fix
        PositionFix('unique', 1 solution, best=(2, 1.5), deviation=0.128 m)
    """
    problem = make_problem(
        xy, ranges=checks.array("ranges", ranges), sigma_range=sigma, weights=weights, loss=loss, loss_scale=loss_scale,
        least=2, reason=", or a circle of solutions remains",
    )  # fmt: skip
    if np.hypot(*(problem.xy - problem.xy[0]).T).max() <= problem.noise:
        return problem.fix([], "coincident")
    if len(problem.xy) == 2:
        both, (meet,) = _pairs(problem, np.array([[0, 1]]))
        return problem.fix(both if meet == "two" else both[:1], str(meet), flat=meet != "two")
    line = in_line(problem.xy, problem.noise)
    starts = np.vstack([_linearised(problem), _pairs(problem, subsets(len(problem.xy), 2))[0]])
    if line is not None:
        return _beside_line(problem, starts, line, known_sigma=sigma is not None)
    return problem.fix(*solve(problem, starts, known_sigma=sigma is not None))


def _pairs(problem: Problem, pairs: NDArray[np.intp]) -> tuple[Floats, NDArray[np.str_]]:
    """Intersect the circles of (N, 2) pairs of beacons: (2 N, 2) points and (N,) statuses; see ``two_circles``."""
    i, j = pairs.T
    variance = problem.sigma_range**2 / problem.weights
    points, status = two_circles(
        problem.points[i], problem.points[j], problem.ranges[i], problem.ranges[j],
        variance[i] / (variance[i] + variance[j]), problem.noise,
    )  # fmt: skip
    flat = points.ravel()
    return np.column_stack([flat.real, flat.imag]), status


def _linearised(problem: Problem) -> Floats:
    """Solve the differences of the circles' equations, linear in the position, for a (1, 2) point.

    Each equation is |p|^2 - 2 m p + |m|^2 = d^2, less the weighted mean of all. Beacons in line put the point on their
    line.
    """
    share = problem.scales**2 / np.sum(problem.scales**2)
    right = (np.sum(problem.xy**2, axis=1) - problem.ranges**2) / 2
    root = np.sqrt(share)
    left = (problem.xy - share @ problem.xy) * root[:, None]
    return np.linalg.lstsq(left, (right - share @ right) * root, rcond=1e-12)[0][None]


def _beside_line(problem: Problem, starts: Floats, line: tuple[Floats, Floats], *, known_sigma: bool) -> PositionFix:
    """Solve for beacons in line: return a solution and its mirror image, or a solution on the line."""
    point, direction = line
    normal = np.array([-direction[1], direction[0]])
    along = ((problem.xy - point) @ direction)[:, None] + problem.ranges[:, None] * (-1, 1)
    on, on_cost = minima(problem, point + along.reshape(-1, 1) * direction, line)
    # Mirror images cost the same: search the left side only.
    aside = (starts - point) @ normal
    states, costs = minima(problem, starts + (np.abs(aside) - aside)[:, None] * normal)
    aside = (states - point) @ normal
    # A solution nearer to the line than the root of the rounding error coincides with its image.
    off = np.abs(aside) > 1e-7 * problem.spread
    states, costs = distinct(problem, states[off] + (np.abs(aside) - aside)[off, None] * normal)
    rounding = (1e-14 * problem.spread * problem.scales.max()) ** 2 * len(problem.xy)
    if not len(states) or on_cost[0] <= costs[0] + rounding:
        status = "at a beacon" if problem.at_beacon(on[0]) else "in line"
        return problem.fix(on[:1], status, flat=True)
    best, _ = pick(states, costs, known_sigma=known_sigma)
    image = best - 2 * ((best - point) @ normal)[:, None] * normal
    return problem.fix(np.stack([best, image], axis=1).reshape(-1, 2), "mirror" if len(best) == 1 else "ambiguous")


# Standard deviation of a bearing without information [rad].
NO_BEARING = 1e100


def locate(
    xy: ArrayLike,
    ranges: ArrayLike,
    bearings: ArrayLike,
    heading: float | None = None,
    *,
    sigma_range: ArrayLike,
    sigma_bearing: ArrayLike,
    weights: ArrayLike | None = None,
    loss: Loss = "linear",
    loss_scale: float = 1.0,
) -> PositionFix:
    """Compute the pose from ranges and bearings of beacons.

    Two beacons suffice, or one if the heading is known. The solution is the minimum of ``sum of rho(weight (residual /
    sigma)^2)`` over ranges and bearings. Gauss-Newton steps start from the rigid motions that map the measured points
    onto the beacons, all or in pairs, and from the intersections of pairs of circles. All minima are returned that the
    noise cannot distinguish from the best.

    A call takes one set of measurements. Coordinates may be as large as in UTM.

    Args:
        xy: (M, 2) positions of the beacons [m].
        ranges: (M,) measured distances [m], >= 0.
        bearings: (M,) directions in the robot's frame, counter-clockwise from straight ahead [rad], any real numbers.
            The bearing to a beacon at range 0 carries no information and is ignored.
        heading: The robot's heading in the world [rad], or None if unknown.
        sigma_range: Standard deviation of the ranges [m], one or (M,), > 0.
        sigma_bearing: Standard deviation of the bearings [rad], one or (M,), > 0.
        weights: (M,) factors >= 0 of the squared residuals; 0 ignores a beacon. The default is 1.
        loss: "linear", "soft_l1", "huber", "cauchy" or "arctan", as in ``scipy.optimize.least_squares``; applied to
            each range and to each bearing.
        loss_scale: Residual at which a robust loss bends [sigma], > 0.

    Returns:
        Poses (S, 3), or positions (S, 2) for a known heading; residuals (S, M, 2), range and bearing. Statuses:
        "unique", "ambiguous", "coincident" (no solution), "at a beacon", "singular".

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: A shape or value breaks its rule, or too few beacons are left.

    Source: lectures, "Distance and Bearing"; Thrun, Burgard and Fox, *Probabilistic Robotics*, section 6.6.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> fix = gs.locate([(3, 0), (0, 4)], [3, 4], [0, np.pi / 2], sigma_range=0.1, sigma_bearing=0.02)
        >>> fix.status, (fix.best + 1e-9).round(3).tolist()
        ('unique', [0.0, 0.0, 0.0])
    """
    given = dict(ranges=ranges, bearings=bearings, sigma_range=sigma_range, sigma_bearing=sigma_bearing)
    least, reason = (2, ", or a circle of solutions remains") if heading is None else (1, "")
    problem = make_problem(
        xy, **{name: checks.array(name, value) for name, value in given.items()}, heading=heading,
        names=("sigma_range", "sigma_bearing"), weights=weights, loss=loss, loss_scale=loss_scale, least=least,
        reason=reason,
    )  # fmt: skip
    if heading is None and np.hypot(*(problem.xy - problem.xy[0]).T).max() <= problem.noise:
        return problem.fix([], "coincident")
    # A huge standard deviation removes the meaningless bearing to a beacon at range 0.
    problem = replace(
        problem, sigma_bearing=np.where(problem.ranges <= problem.touch, NO_BEARING, problem.sigma_bearing)
    )
    return problem.fix(*solve(problem, _starts(problem), known_sigma=True))


def _starts(problem: Problem) -> Floats:
    """Return (N, d) starts: rigid motions of all beacons and of pairs, and intersections of circles with headings."""
    world, count = problem.points, len(problem.xy)
    if problem.heading is not None:
        # Each beacon and a known heading determine a position.
        positions = world - problem.ranges * np.exp(1j * (problem.bearings + problem.heading))
        points, headings = np.append(positions, positions.mean()), np.full(count + 1, problem.heading)
    else:
        parts = [_rigid(problem, sets) for sets in (np.arange(count)[None], subsets(count, 2))]
        points, headings = (np.concatenate(part) for part in zip(*parts, strict=True))
    if count > 1:
        i, j = subsets(count, 2).T
        crossing = two_circles(world[i], world[j], problem.ranges[i], problem.ranges[j], noise=problem.noise)[0].ravel()
        seen = np.angle(world - crossing[:, None]) - problem.bearings
        facing = np.angle(np.exp(1j * seen).sum(axis=1))
        points, headings = np.append(points, crossing), np.append(headings, facing)
    return np.column_stack([points.real, points.imag, wrap(headings)])[:, : problem.dimension]


def _rigid(problem: Problem, sets: NDArray[np.intp]) -> tuple[NDArray[np.complex128], Floats]:
    """Return (N,) positions and headings that map the measured points of (N, K) beacons onto the beacons.

    The heading of least squares is the angle of sum conj(z_i - z) (m_i - m), with means z and m (Horn 1987, in the
    plane).
    """
    seen = (problem.ranges * np.exp(1j * problem.bearings))[sets]
    world = problem.points[sets]
    # Error of a measured point, along and across the ray.
    variance = problem.sigma_range**2 + (problem.ranges * problem.sigma_bearing) ** 2
    share = (problem.weights / variance)[sets]
    share = share / share.sum(axis=1, keepdims=True)
    middle, centre = (share * seen).sum(axis=1), (share * world).sum(axis=1)
    heading = np.angle((share * np.conj(seen - middle[:, None]) * (world - centre[:, None])).sum(axis=1))
    return centre - middle * np.exp(1j * heading), wrapped(heading)
