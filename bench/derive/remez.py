"""Find minimax polynomials by Remez's exchange, with mpmath."""

from __future__ import annotations

from collections.abc import Callable

import mpmath as mp

Function = Callable[[mp.mpf], mp.mpf]


def polynomial(powers: list, z: mp.mpf) -> mp.mpf:
    """Evaluate a polynomial by Horner's rule; coefficients begin with the lowest power."""
    value = mp.mpf(0)
    for power in reversed(powers):
        value = value * z + power
    return value


def remez(f: Function, weight: Function, grid: list[mp.mpf], count: int) -> list[mp.mpf]:
    """Return the polynomial with the smallest maximal weighted error on a grid, lowest power first."""
    targets, weights = [f(z) for z in grid], [weight(z) for z in grid]
    last = len(grid) - 1
    chosen = [round((1 - mp.cos(mp.pi * (i + 0.5) / (count + 1))) / 2 * last) for i in range(count + 1)]
    powers: list = []
    for _ in range(30):
        rows = [[grid[i] ** k for k in range(count)] + [(-1) ** j / weights[i]] for j, i in enumerate(chosen)]
        powers = list(mp.lu_solve(mp.matrix(rows), mp.matrix([targets[i] for i in chosen])))[:count]
        error = weighted_errors(powers, targets, weights, grid)
        # The largest error between two sign changes.
        runs: list[int] = []
        for i, e in enumerate(error):
            if not runs or e * error[runs[-1]] < 0:
                runs.append(i)
            elif abs(e) > abs(error[runs[-1]]):
                runs[-1] = i
        if runs == chosen or len(runs) != count + 1:
            break
        chosen = runs
    return powers


def weighted_errors(powers: list, targets: list, weights: list, grid: list) -> list[mp.mpf]:
    """Return the weighted errors of a polynomial at the points of a grid."""
    return [(polynomial(powers, z) - t) * w for z, t, w in zip(grid, targets, weights, strict=True)]
