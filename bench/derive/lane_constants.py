"""Derive the constants of ``lanes/math`` in OpenCL and Warp with mpmath, and print them and their errors.

Minimax polynomials (Remez's exchange) for the relative error of the function: e^r = 1 + r + r^2 E(r) for |r| <=
log(2)/2, judged by e^r - 1; log(1 + f) = f - f^2/2 + f^3 L(f) for 1 + f from sqrt(1/2) to sqrt(2); erf(x) = 1 - exp(-x
W(x)) for x up to 4, judged by erf; log erfc(x) = -x V(x) for x up to 4, judged by 1 - log(erfc(x) / 2); arctan t = t +
t^3 A(t^2) for t up to tan(pi/8). log 2 is split into a part whose products with counts are exact, and the rest.
"""

from __future__ import annotations

from collections.abc import Callable

import mpmath as mp
import numpy as np

mp.mp.dps = 50
# log(2)/2 with a margin for counts that are rounded to the wrong side.
HALF = mp.log(2) / 2 * (1 + mp.mpf(2) ** -10)
LOW, HIGH = mp.sqrt(0.5) - 1, mp.sqrt(2) - 1
ERF_ONE = mp.mpf(4)
# tan(pi/8) with a margin for rounding.
ARC_END = (mp.sqrt(2) - 1) * (1 + mp.mpf(2) ** -10)
# Bits of the first part of log 2; counts have at most 8.
PART_BITS = 16
POINTS = 1001


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


def rounded_polynomial(
    f: Function, weight: Function, low: mp.mpf, high: mp.mpf, count: int
) -> tuple[list[float], float]:
    """Return the polynomial of ``remez`` rounded to float32, and log2 of its largest weighted error."""
    middle, reach = (low + high) / 2, (high - low) / 2
    grid = [middle - reach * mp.cos(mp.pi * (i + 0.5) / POINTS) for i in range(POINTS)]
    rounded = [float(np.float32(float(c))) for c in remez(f, weight, grid, count)]
    error = weighted_errors(rounded, [f(z) for z in grid], [weight(z) for z in grid], grid)
    return rounded, float(mp.log(max(map(abs, error)), 2))


def exponential() -> tuple[list[float], float]:
    """Return E and its error."""
    return rounded_polynomial(lambda r: (mp.expm1(r) - r) / r**2, lambda r: r**2 / abs(mp.expm1(r)), -HALF, HALF, 5)


def logarithm() -> tuple[list[float], float]:
    """Return L and its error."""
    return rounded_polynomial(lambda f: (mp.log1p(f) - f + f**2 / 2) / f**3, lambda f: f**3 / mp.log1p(f), LOW, HIGH, 8)


def error_function() -> tuple[list[float], float]:
    """Return W and its error."""
    zero = mp.mpf(0)
    return rounded_polynomial(lambda x: -mp.log(mp.erfc(x)) / x, lambda x: x * mp.erfc(x) / mp.erf(x), zero, ERF_ONE, 9)


def log_complement() -> tuple[list[float], float]:
    """Return V and its error."""
    return rounded_polynomial(
        lambda x: -mp.log(mp.erfc(x)) / x, lambda x: x / (1 - mp.log(mp.erfc(x) / 2)), mp.mpf(0), ERF_ONE, 10
    )


def arc() -> tuple[list[float], float]:
    """Return A and its error."""
    return rounded_polynomial(
        lambda z: (mp.atan(mp.sqrt(z)) / mp.sqrt(z) - 1) / z, lambda z: z, mp.mpf(0), ARC_END**2, 5
    )


def log_parts() -> list[float]:
    """Return log 2 as a part of 16 bits and the rest, and its reciprocal."""
    scale = mp.mpf(2) ** PART_BITS
    first = mp.floor(mp.log(2) * scale) / scale
    return [float(first), *(float(np.float32(float(v))) for v in (mp.log(2) - first, 1 / mp.log(2)))]


def main() -> None:
    """Print everything."""
    made = {"E": exponential(), "L": logarithm(), "W": error_function(), "V": log_complement(), "A": arc()}
    for name, (powers, error) in made.items():
        print(name, ", ".join(f"{c:.9g}f" for c in powers), f"relative error 2^{error:.1f}")
    print("log 2 in parts, and 1 / log 2", *(f"{part:.9g}f" for part in log_parts()))


if __name__ == "__main__":
    main()
