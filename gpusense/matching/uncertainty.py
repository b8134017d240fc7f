"""Information of a match, from its pairs, and its status.

The inverse information of Gauss-Newton times the variance of the errors is a covariance, both corrected for the weights
of normal errors; ``observability`` first removes the information that noise contributes.

Errors of neighbours are correlated: they share points of a line, and errors of a surface. The variance of their
weighted sum is 1 + 2 sum rho_k times that of independent errors, with the autocorrelation rho_k over k points. Blocks
of successive points measure it (Flyvbjerg and Petersen (1989), "Error estimates on averages of correlated data"): the
sum of squares of the sums of blocks of b points is 1 + 2 sum (1 - k / b) rho_k times that of single points.
"""

from __future__ import annotations

import bisect
import functools
import itertools
from collections.abc import Sequence

import numpy as np

from gpusense.backends import Backend
from gpusense.matching.columns import (
    Column,
    Triangle,
    chosen,
    column_of,
    columns_of,
    is_not,
    larger,
    matrices_of,
    triangle_of,
    values_of,
)
from gpusense.matching.icp import LONG_WIDTH, WIDTH, IcpPairs, points_of_line, space_of
from gpusense.matching.observability import LEAST_PAIRS, Observed, observed_information
from gpusense.matching.options import MatchOptions
from gpusense.matching.points import scan_points
from gpusense.world.scanner import Scanner

# Least pairs of points of a match, least share of points in common sight, and least score.
_FEW, _OVERLAP, _POOR = 5, 0.1, 0.46
_STATUSES = np.array(["converged", "unobservable", "no convergence", "poor", "no overlap", "few points"], "<U16")
# Number of pairs as which the prior noise counts.
_PRIOR_PAIRS = 2.0
# Least variance of a point [m^2]: float32 resolves about a micrometre at ten metres.
_LEAST_VARIANCE = 1e-9
# A match has converged if its last step along observed directions is shorter than this [deviations of the pose].
_SHORT = 0.5


def noise_of(ratio: Column) -> tuple[Column, Column]:
    """Return the deviation of normal errors, and the factor of the covariance, from a weighted mean of squared errors.

    ``ratio`` (S,) is the sum of w e^2 over the sum of w, for errors in scales, and weights (1 / (1 + e^2))^2.
    Deviations are at most 2; the factor of the inverse of the sum of w J J' is E[w] E[w^2 e^2] / E[d(w e)/de]^2.
    """
    if isinstance(ratio, np.ndarray):
        known, sigma, factor = _noise_table()
        return np.interp(ratio, known, sigma), np.interp(ratio, known, factor)
    return _between(float(ratio))


def _between(ratio: float) -> tuple[float, float]:
    """Return the numbers of ``noise_of`` for one ratio, with the bits of ``numpy.interp``."""
    known, sigma, factor = _noise_lists()
    if not ratio < known[-1]:
        return (sigma[-1], factor[-1]) if ratio == ratio else (ratio, ratio)
    k = max(bisect.bisect_right(known, ratio) - 1, 0)
    off, step = larger(ratio - known[k], 0.0), known[k + 1] - known[k]
    return (sigma[k + 1] - sigma[k]) / step * off + sigma[k], (factor[k + 1] - factor[k]) / step * off + factor[k]


@functools.cache
def _noise_lists() -> list[list[float]]:
    """Return the ratios, deviations and factors as Python's numbers."""
    return [column.tolist() for column in _noise_table()]


@functools.cache
def _noise_table() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ratios, deviations and factors of noise_of."""
    e = np.linspace(-8, 8, 801)
    sigma = np.linspace(0.0, 2.0, 101)[1:]
    u = sigma[:, None] * e
    density = np.exp(-0.5 * e * e)
    density /= density.sum()
    w = (1 + u * u) ** -2.0
    mean_w, mean_wuu = w @ density, (w * u * u) @ density
    slope = ((1 - 3 * u * u) * (1 + u * u) ** -3.0) @ density
    factor = mean_w * ((w * w * u * u) @ density) / np.maximum(slope, 0.05) ** 2
    return np.append(0, mean_wuu / mean_w), np.append(0, sigma), np.append(0, factor)


def inflation_of(squares: Sequence[Column]) -> Column:
    """Return the variances of sums of weighted errors, relative to independent errors; at least 1.

    The ratio to single points rises with the size of blocks, and is less certain for large ones. So its steps are
    summed until the first one that is not positive. The last of them counts twice: once blocks are longer than the
    correlation, each step is half of the one before.

    Args:
        squares: 8 columns: sums of squares of the sums of blocks of 1, 2, 4 to 128 points.
    """
    first = chosen(squares[0] > 0, squares[0], 1.0)
    rises, total, last = first > 0, 0.0, 0.0
    for before, after in itertools.pairwise([square / first for square in squares]):
        step = after - before
        rises = rises & (step > 0)
        if rises is False:
            break
        total, last = total + chosen(rises, step, 0.0), chosen(rises, step, last)
    return 1 + total + last


def variance_of(
    squared: Column, pairs: Column, scale: Column, noise: Column, inflation: Column
) -> tuple[Column, Column]:
    """Return the variance of single errors [m^2], and the factor of the inverse information.

    The three fitted numbers of a pose reduce the degrees of freedom, and the prior noise adds some. ``squared`` are
    weighted mean squared errors [m^2], ``pairs`` sums of weights, ``scale`` scales of the weights and ``noise``
    deviations of ranges [m]. ``inflation`` are factors of the covariance because errors of neighbours are correlated.
    """
    square = scale * scale
    # Squares of tiny scales are 0.
    sigma, factor = noise_of(np.divide(squared, square))
    whole = inflation * factor * square
    whole = (whole * pairs + _PRIOR_PAIRS * (noise * noise)) / (larger(pairs - 3, 0.5) + _PRIOR_PAIRS)
    deviation = sigma * scale
    return deviation * deviation, larger(whole, _LEAST_VARIANCE)


def observed_pairs(
    information: Triangle, doubt: Triangle, variance: Column, lever: Column, lines: Column | None,
    unneeded: Column = False,
) -> Observed:  # fmt: skip
    """Return the information that pairs of points and lines observe, of sums of w J J'.

    ``doubt`` is the part due to a unit variance of the points, ``variance`` their variance [m^2]; see
    ``observability.observed_information`` for the rest.
    """
    spurious = [part * variance for part in doubt]
    return observed_information(information, spurious, lever, lines, LEAST_PAIRS, unneeded)


def statuses(result: np.ndarray, lost: Column, step: Column) -> np.ndarray:
    """Return the status of (S, 35) results of the kernel ``match_scans``.

    ``step`` is the length of the last step in deviations of the pose, along observed directions.
    """
    numbers = columns_of(result)
    seen, through, unseen = numbers[21:24]
    code = chosen(lost > 0, 1, 0)
    # Of several reasons, the last one counts.
    reasons = (
        (numbers[5] == 0) & is_not(step < _SHORT), numbers[3] < _POOR,
        seen < _OVERLAP * larger(seen + through + unseen, 1.0), numbers[18] < _FEW,
    )  # fmt: skip
    for number, failed in enumerate(reasons, 2):
        code = chosen(failed, number, code)
    status: np.ndarray = _STATUSES[values_of(code)]
    return status


def observable_directions(
    ranges: np.ndarray, pose: np.ndarray, variance: np.ndarray, scanner: Scanner, backend: Backend, real: np.dtype,
    options: MatchOptions,
) -> np.ndarray:  # fmt: skip
    """Return the information (S, 3, 3) on poses by the scans' lines, 0 along directions that they do not observe.

    Distances to a map ignore lines: the ends of a corridor's walls in the map, or gaps between cells, seem to constrain
    the position along the corridor. A scan matched with itself has the information of its lines. ``ranges`` are (S, K)
    readings [m], ``pose`` (S, 3) poses of the robot, ``variance`` (S,) variances of distances from the map [m^2].
    """
    points = scan_points(ranges, scanner, real)
    everything = np.arange(len(pose))
    lock, space = space_of(backend)
    noise = np.full(len(pose), options.noise)
    with lock, space:
        device = IcpPairs(backend, real, points, np.stack([everything, everything], axis=1), noise, space)
        device.fit_lines(lambda level: max(WIDTH, LONG_WIDTH * level))
        rules = options.rules(int(points.counts.max(initial=0)), points.gap)
        result = device.run(everything, np.zeros((len(pose), 1, 3)), [rules])[:, 0]
    turned = _turned(pose[:, 2], scanner.mount[:2])
    numbers, back = columns_of(result), turned.transpose(0, 2, 1)
    information, doubt = (triangle_of(turned @ matrices_of(numbers[at : at + 6]) @ back) for at in (6, 12))
    lever = points.rms_range(everything)
    deviation, length = column_of(noise), column_of(lever)
    lines = numbers[19] / points_of_line(points.gap, deviation, length)
    found = observed_pairs(information, doubt, deviation**2, length, lines)
    return matrices_of(found.information) / np.maximum(variance, 1e-12)[:, None, None]


def _turned(heading: np.ndarray, mount: tuple[float, float]) -> np.ndarray:
    """Return (S, 3, 3) derivatives that convert information on sensors' poses to that on robots' poses in the world."""
    c, s, (x, y) = np.cos(heading), np.sin(heading), mount
    zero, one = np.zeros(len(c)), np.ones(len(c))
    return np.stack([c, -s, zero, s, c, zero, zero - y, zero + x, one], axis=1).reshape(-1, 3, 3)
