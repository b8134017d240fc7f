"""The lowest minima of a problem's cost: least squares from several starts, so that no start need be good."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gpusense.positions.closed_forms import wrap
from gpusense.positions.problem import LOSSES, Floats, Problem

# Starts that are followed down to their minima, and how far apart they lie, in the scene's spread (or radians).
FOLLOWED = 8
APART = 0.05
# Minima nearer to each other are one.
SAME = 1e-6
# How little a step must change while starts are followed; the lowest minima are then found to rounding.
COARSE, FINE = 1e-4, 1e-15
# Minima whose costs differ by less cannot be told apart: 3 sigma of a likelihood ratio.
AMBIGUOUS = 9.0


def distance(problem: Problem, states: Floats, state: Floats) -> Floats:
    """(S,) how far states lie apart, in the scene's spread and in radians, whichever is more."""
    away = np.hypot(*(states[:, :2] - state[:2]).T) / (problem.spread or 1.0)
    return away if problem.dimension == 2 else np.maximum(away, np.abs(wrap(states[:, 2] - state[2])))


def descend(problem: Problem, start: Floats, line: tuple[Floats, Floats] | None, step: float) -> Floats:
    """The minimum that least squares (trust-region Gauss-Newton of SciPy) reaches from a start.

    Args:
        problem: What is measured.
        start: (d,) a state.
        line: A point and a direction (2,) that the position must not leave; None lets it go anywhere.
        step: Relative change of the cost and of the state at which it stops.
    """
    from scipy.optimize import least_squares

    unit = np.ones(problem.dimension)
    unit[:2] = problem.spread or 1.0
    # Columns are the directions in which the state may move, in units that make them alike.
    base, moves = np.zeros(problem.dimension), np.diag(unit)
    if line is not None:
        base[:2] = line[0]
        moves = np.delete(moves, 1, axis=1)
        moves[:2, 0] = line[1] * unit[0]
    scales = problem.scales

    def residuals(x: Floats) -> Floats:
        return problem.residuals((base + moves @ x)[None])[0] * scales

    def jacobian(x: Floats) -> Floats:
        # Residuals are measured less expected.
        return -(problem.jacobian(base + moves @ x) * scales[:, None]) @ moves

    def rho(z: Floats) -> Floats:
        return np.stack(LOSSES[problem.loss](z))

    x0 = np.linalg.lstsq(moves, start - base, rcond=None)[0]
    found = least_squares(
        residuals, x0, jacobian, loss="linear" if problem.loss == "linear" else rho, f_scale=problem.loss_scale,
        ftol=step, xtol=step, gtol=FINE, x_scale="jac", max_nfev=200,
    )  # fmt: skip
    return base + moves @ found.x


def minima(
    problem: Problem, starts: Sequence[Floats] | Floats, line: tuple[Floats, Floats] | None = None
) -> tuple[Floats, Floats]:
    """Different minima, the lowest first, and their costs.

    Args:
        problem: What is measured.
        starts: (N, d) states; those that are not finite are left out. The best of them are followed, each at least
            APART from those before it.
        line: As for :func:`descend`.

    Returns:
        (S, d) and (S,), of minima that come near the lowest; S is 0 where no start is finite.
    """
    left = np.asarray(starts, np.float64).reshape(-1, problem.dimension)
    left = left[np.isfinite(left).all(axis=1)]
    left = left[np.argsort(problem.costs(left), kind="stable")]
    found: list[Floats] = []
    for _ in range(FOLLOWED):
        if not len(left):
            break
        start, left = left[0], left[1:]
        state = descend(problem, start, line, COARSE)
        for near in (start, state):
            left = left[distance(problem, left, near) > APART]
        if not found or distance(problem, np.array(found), state).min() > APART / 10:
            found.append(state)
    states = np.array(found).reshape(-1, problem.dimension)
    costs = problem.costs(states)
    near = states[costs <= 1.1 * costs.min(initial=np.inf) + 2 * AMBIGUOUS]
    fine = [descend(problem, state, line, FINE) for state in near]
    return distinct(problem, np.array(fine).reshape(-1, problem.dimension))


def distinct(problem: Problem, states: Floats) -> tuple[Floats, Floats]:
    """The different ones of (S, d) states, the lowest first, and their costs."""
    costs = problem.costs(states)
    kept: list[int] = []
    for k in np.argsort(costs, kind="stable"):
        if not kept or distance(problem, states[kept], states[k]).min() > SAME:
            kept.append(int(k))
    return states[kept], costs[kept]


def pick(states: Floats, costs: Floats, *, told: bool) -> tuple[Floats, str]:
    """The solutions out of minima, and the status: one, or all that the known noise cannot tell apart."""
    if not told or len(states) < 2:
        return states[:1], "unique"
    near = costs - costs[0] < AMBIGUOUS
    return states[near], "ambiguous" if near.sum() > 1 else "unique"


def in_line(points: Floats, noise: float) -> tuple[Floats, Floats] | None:
    """The line on which points stand to rounding: a point and a unit vector, from the first to the farthest of them.

    None where they do not stand in line. Points at one place have no line either: ask that first.
    """
    offset = points - points[0]
    away = np.hypot(offset[:, 0], offset[:, 1])
    far = int(np.argmax(away))
    direction = offset[far] / away[far]
    aside = np.abs(offset[:, 1] * direction[0] - offset[:, 0] * direction[1])
    # Coordinates are rounded on both ends of an offset, and the farthest one turns the line.
    return (points[0], direction) if aside.max() <= 8 * noise else None


def reflect(states: Floats, line: tuple[Floats, Floats]) -> Floats:
    """Mirror images of (S, 2) positions on the other side of a line."""
    point, direction = line
    offset = states - point
    return point + 2 * (offset @ direction)[:, None] * direction - offset
