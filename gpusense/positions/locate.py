"""Locate: compute a pose from ranges and bearings of beacons."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util.angles import wrapped
from gpusense._util.typing import Floats, Loss
from gpusense.positions.closed_forms import two_circles, wrap
from gpusense.positions.fix import PositionFix
from gpusense.positions.problem import Problem, check_operands, make_problem, subsets
from gpusense.positions.solver import solve

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
    check_operands(ranges=ranges, bearings=bearings, sigma_range=sigma_range, sigma_bearing=sigma_bearing)
    least, reason = (2, ", or a circle of solutions remains") if heading is None else (1, "")
    problem = make_problem(
        xy, ranges=ranges, bearings=bearings, heading=heading, sigma_range=sigma_range, sigma_bearing=sigma_bearing,
        names=("sigma_range", "sigma_bearing"), weights=weights, loss=loss, loss_scale=loss_scale, least=least,
        reason=reason,
    )  # fmt: skip
    if heading is None and np.hypot(*(problem.xy - problem.xy[0]).T).max() <= problem.noise:
        return problem.fix([], "coincident")
    assert problem.ranges is not None
    # A huge standard deviation removes the meaningless bearing to a beacon at range 0.
    problem = replace(
        problem, sigma_bearing=np.where(problem.ranges <= problem.touch, NO_BEARING, problem.sigma_bearing)
    )
    return problem.fix(*solve(problem, _starts(problem), known_sigma=True))


def _starts(problem: Problem) -> Floats:
    """Return (N, d) starts: rigid motions of all beacons and of pairs, and intersections of circles with headings."""
    assert problem.ranges is not None and problem.bearings is not None
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
    assert problem.ranges is not None and problem.bearings is not None
    seen = (problem.ranges * np.exp(1j * problem.bearings))[sets]
    world = problem.points[sets]
    # Error of a measured point, along and across the ray.
    variance = problem.sigma_range**2 + (problem.ranges * problem.sigma_bearing) ** 2
    share = (problem.weights / variance)[sets]
    share = share / share.sum(axis=1, keepdims=True)
    middle, centre = (share * seen).sum(axis=1), (share * world).sum(axis=1)
    heading = np.angle((share * np.conj(seen - middle[:, None]) * (world - centre[:, None])).sum(axis=1))
    return centre - middle * np.exp(1j * heading), wrapped(heading)
