"""Find the lowest minima of a problem's cost by least squares from several starts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gpusense._util.typing import Floats
from gpusense.positions.fix import wrap
from gpusense.positions.problem import Problem

# Largest number of starts to follow, and the least distance between them, in spreads of the scene (or radians).
FOLLOWED = 8
APART = 0.05
# Minima within this distance count as the same.
SAME = 1e-6
# Relative changes at which the search stops: coarse from the starts, then at rounding from the lowest minima.
COARSE, FINE = 1e-4, 1e-15
# Minima whose costs differ by less are ambiguous: 3 sigma of a likelihood ratio.
AMBIGUOUS = 9.0


def distance(problem: Problem, states: Floats, state: Floats) -> Floats:
    """Return (S,) distances of ``states`` from ``state``: the larger of position (in spreads) and heading [rad]."""
    away = np.hypot(*(states[:, :2] - state[:2]).T) / (problem.spread or 1.0)
    return away if problem.dimension == 2 else np.maximum(away, np.abs(wrap(states[:, 2] - state[2])))


def descend(problem: Problem, start: Floats, line: tuple[Floats, Floats] | None, step: float) -> Floats:
    """Return the minimum that least squares (trust-region Gauss-Newton of SciPy) reaches from a (d,) state.

    ``line`` (point, direction) constrains the position; ``step`` is the relative change at which the search stops.
    """
    from scipy.optimize import least_squares

    # Columns are the free directions of the state, with positions in spreads of the scene, comparable to headings.
    base, moves, scales = np.zeros(problem.dimension), np.eye(problem.dimension), problem.scales
    moves[:2] *= problem.spread or 1.0
    if line is not None:
        base[:2], moves = line[0], np.delete(moves, 1, axis=1)
        moves[:2, 0] = moves[0, 0] * line[1]
    result = least_squares(
        lambda x: problem.residuals((base + moves @ x)[None])[0] * scales,
        np.linalg.lstsq(moves, start - base, rcond=None)[0],
        # A residual is the measured less the expected value.
        lambda x: -(problem.jacobian(base + moves @ x) * scales[:, None]) @ moves,
        loss=problem.loss, f_scale=problem.loss_scale, ftol=step, xtol=step, gtol=FINE, x_scale="jac", max_nfev=200,
    )  # fmt: skip
    return base + moves @ result.x


def minima(
    problem: Problem, starts: Sequence[Floats] | Floats, line: tuple[Floats, Floats] | None = None
) -> tuple[Floats, Floats]:
    """Return (S, d) different minima near the lowest, sorted, and their (S,) costs, from finite (N, d) starts."""
    pending = np.asarray(starts, np.float64).reshape(-1, problem.dimension)
    pending = pending[np.isfinite(pending).all(axis=1)]
    pending = pending[np.argsort(problem.costs(pending), kind="stable")]
    coarse: list[Floats] = []
    for _ in range(FOLLOWED):
        if not len(pending):
            break
        start, pending = pending[0], pending[1:]
        state = descend(problem, start, line, COARSE)
        for near in (start, state):
            pending = pending[distance(problem, pending, near) > APART]
        if not coarse or distance(problem, np.array(coarse), state).min() > APART / 10:
            coarse.append(state)
    states = np.array(coarse).reshape(-1, problem.dimension)
    costs = problem.costs(states)
    near = states[costs <= 1.1 * costs.min(initial=np.inf) + 2 * AMBIGUOUS]
    fine = [descend(problem, state, line, FINE) for state in near]
    return distinct(problem, np.array(fine).reshape(-1, problem.dimension))


def distinct(problem: Problem, states: Floats) -> tuple[Floats, Floats]:
    """Return the different states of (S, d) states, the lowest cost first, and their costs."""
    costs = problem.costs(states)
    unique: list[int] = []
    for k in np.argsort(costs, kind="stable"):
        if not unique or distance(problem, states[unique], states[k]).min() > SAME:
            unique.append(int(k))
    return states[unique], costs[unique]


def pick(states: Floats, costs: Floats, *, known_sigma: bool) -> tuple[Floats, str]:
    """Pick the lowest minimum, with known noise all that it cannot distinguish; return them and the status."""
    if not known_sigma or len(states) < 2:
        return states[:1], "unique"
    near = costs - costs[0] < AMBIGUOUS
    return states[near], "ambiguous" if near.sum() > 1 else "unique"


def solve(problem: Problem, starts: Sequence[Floats] | Floats, *, known_sigma: bool) -> tuple[Floats, str]:
    """Return the solutions from starts, the best first, and the status."""
    states, status = pick(*minima(problem, starts), known_sigma=known_sigma)
    return states, "at a beacon" if problem.at_beacon(states[0]) else status


def in_line(points: Floats, noise: float) -> tuple[Floats, Floats] | None:
    """Return the line from the first of different points to the farthest (point, unit vector), None unless in line."""
    offset = points - points[0]
    away = np.hypot(offset[:, 0], offset[:, 1])
    far = int(np.argmax(away))
    direction = offset[far] / away[far]
    aside = np.abs(offset[:, 1] * direction[0] - offset[:, 0] * direction[1])
    # Rounding affects both ends of an offset, and the farthest point's rounding turns the line.
    return (points[0], direction) if aside.max() <= 8 * noise else None
