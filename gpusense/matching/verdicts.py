"""Judge matches: information from their pairs, the directions that they observe, status and probability.

The inverse information of Gauss-Newton times the variance of the errors is a covariance, both corrected for the weights
of normal errors; ``observability`` first removes the information that noise contributes. Errors of neighbours are
correlated: they share points of a line, and errors of a surface. The variance of their weighted sum is 1 + 2 sum rho_k
times that of independent errors, with the autocorrelation rho_k over k points. Blocks of successive points measure it
(Flyvbjerg and Petersen (1989), "Error estimates on averages of correlated data"): the sum of squares of the sums of
blocks of b points is 1 + 2 sum (1 - k / b) rho_k times that of single points.

The probability is a logistic function of the evidence that the scans give at the pose. Its weights were fitted by
``bench/derive/match_evidence.py`` to matches of scans from simulations and from half of the recorded logs, of
neighbouring places and of places without anything in common; right and wrong poses have equal weight.
``bench/accuracy/match_verdicts.py`` compares predicted and actual shares of right matches for both halves.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gpusense.backends import Backend
from gpusense.matching.columns import (
    Column,
    Triangle,
    all_of,
    any_of,
    chosen,
    column_of,
    columns_of,
    is_not,
    larger,
    matrices_of,
    rows_of,
    smaller,
    square_root,
    upright,
    values_of,
)
from gpusense.matching.icp import LONG_WIDTH, WIDTH, IcpPairs, PlacedPairs, points_of_line, space_of
from gpusense.matching.observability import (
    LEAST_PAIRS,
    Observed,
    axes_of,
    covariance_of,
    observed_information,
    spanning,
)
from gpusense.matching.options import MatchOptions
from gpusense.matching.points import ScanPoints
from gpusense.matching.result import ScanMatch, is_usable

NAMES = ("disagreement", "contradiction", "overlap", "pairs", "roughness", "misfit", "lost", "rival", "distance")
"""Evidence for and against a match.

``disagreement``: 1 less the score. ``contradiction``: share of the points in common sight that one scan saw through.
``overlap``: share of all points that are in common sight. ``pairs``: number of pairs of points. ``roughness``: root
mean square error of pairs over the noise. ``misfit``: 1 less the mean weight of pairs. ``lost``: number of directions
that are not observed. ``rival``: 1 where another pose agrees about equally well. ``distance``: distance from the guess
over the window's half width.
"""

# A fully observed pose is doubtful below the first probability, a partly observed one below the second: it is used only
# along its observed directions, together with its p_right.
DOUBTED, DOUBTED_PARTLY = 0.65, 0.03
# Constant, then weights: of the logarithms of disagreement, contradiction, overlap, pairs, roughness and misfit, of one
# lost direction, of a second one, of a rival, and of the logarithm of the distance.
_CONSTANT = -3.123
_WEIGHTS = (-1.350, -0.164, 1.574, -0.067, -0.202, -0.692, -1.395, 0.622, -2.158, -1.788)
# Offset of distances, and lower bounds of the arguments of logarithms; of lost and rival there are none.
_NEAR = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.04])
_LEAST = np.array([1e-3, 3e-3, 1e-3, 1.0, 0.1, 1e-2, 1.0, 1.0, 0.0])
# Logarithm of the largest odds against a pose: the exponential of larger ones overflows.
_MOST = 700.0
# Distances from guesses are relative to windows of at least this [m].
_LEAST_WINDOW = 0.1
# Mean square turn of lines by noise [rad^2] from which longer lines decide which directions are observed.
_TURNED_LINES = 0.05


class PairSums(NamedTuple):
    """Information of pairs in the sensors' frames, and factors of covariances, for S matches."""

    found: Observed
    factor: Column


def tested(
    device: PlacedPairs, result: np.ndarray, gap: float, lever: np.ndarray, noise: np.ndarray,
    levels: Sequence[MatchOptions], noisy: Column,
) -> PairSums:  # fmt: skip
    """Return the directions that pairs observe, by the matches' lines or, where noise may turn these, by longer lines.

    ``result`` (S, 35) are the matches; ``gap`` is the largest step between the bearings of two neighbours that hides
    nothing [rad], ``lever`` (S,) the root mean square range of the second scan and ``noise`` (S,) the deviation of
    ranges [m].
    """
    numbers, deviation = columns_of(result), column_of(noise)
    weights = larger(numbers[19], 1e-30)
    scales = [options.least_scale for options in levels]
    scale = scales[0] if len(scales) == 1 else np.array(scales)[device.level]
    variance, factor = variance_of(numbers[20] / weights, numbers[19], scale, deviation, inflation_of(numbers[24:32]))
    largest = larger(variance, deviation * deviation)
    # Short lines decide only where the result is beyond doubt.
    are_longer = LONG_WIDTH * deviation > WIDTH
    found = observed_pairs(numbers[6:12], numbers[12:18], largest, column_of(lever), None, are_longer)
    turned = noisy | ((numbers[12] + numbers[15]) * largest > _TURNED_LINES * weights)
    longer_lines = ((found.lost > 0) | turned) & are_longer
    if any_of(longer_lines):
        rows = np.flatnonzero(longer_lines)
        device.fit_lines(lambda level: LONG_WIDTH * level, rows)
        strides = [
            options.rules(most, gap).stride for options, (_, most) in zip(levels, device.most_points(rows), strict=True)
        ]
        rules = [
            options.last_rules(gap)._replace(stride=stride, thin=1)
            for options, stride in zip(levels, strides, strict=True)
        ]
        longer = device.run(rows, result[rows, None, :3], rules)[:, 0]
        # A subset represents all points.
        longer[:, 6:18] *= np.array(strides)[device.level[rows], None]
        lines = numbers[19] / points_of_line(gap, deviation, column_of(lever))
        spread, ranges, lines = (column_of(values_of(column)[rows]) for column in (largest, lever, lines))
        numbers = columns_of(longer)
        found = found.replaced(rows, observed_pairs(numbers[6:12], numbers[12:18], spread, ranges, lines))
    return PairSums(found, factor)


def concluded(
    pose: np.ndarray, information: Triangle, factor: Column, score: np.ndarray, iterations: np.ndarray,
    status: np.ndarray, lever: np.ndarray, other: np.ndarray, evidence: np.ndarray, pairs: np.ndarray,
    noise: np.ndarray, window: tuple[float, float],
) -> ScanMatch:  # fmt: skip
    """Return matches whose information is 0 where they failed, and spans both poses where there are two.

    ``factor`` turns the information into a sum over pairs [m^2]; ``lever`` (S,) are root mean square ranges and
    ``noise`` (S,) deviations of ranges [m]; ``other`` (S, 3) offsets to poses that agree about as well, NaN without
    one; ``evidence`` (S, E) numbers of :data:`NAMES`; ``pairs`` (S,) sums of weights; ``window`` half widths of
    the search [m, rad].
    """
    usable, lever_column = is_usable(column_of(status)), column_of(lever)
    matrices, two = matrices_of(information), usable & has_rival(other)
    if any_of(two):
        matrices = spanning(matrices, np.where(upright(two), other, 0.0))
        status = np.where(values_of(two), "ambiguous", status)
    values, vectors = axes_of(matrices, lever_column)
    kept = (values, vectors) if all_of(usable) else None
    if kept is None:
        # These are not the axes of the information that is kept.
        matrices = np.where(upright(usable, 2), matrices, 0.0)
    shares = values * upright(factor / larger(column_of(pairs), 1.0))
    covariance = covariance_of(matrices, lever_column, window, kept)
    return ScanMatch._of({
        "pose": pose, "covariance": covariance, "information": matrices, "p_right": np.zeros(len(pose)),
        "score": score, "iterations": iterations.astype(np.int64), "eigenvalues": shares,
        "directions": vectors.transpose(0, 2, 1), "lever": lever, "noise": noise, "evidence": evidence,
        "status": status,
    })  # fmt: skip


def judged(match: ScanMatch, guess: np.ndarray, options: MatchOptions) -> ScanMatch:
    """Return S matches of ``concluded`` with their p_right; doubtful ones and those beyond the window have failed."""
    offset = match.pose - guess
    evidence, (x, y, _) = match.evidence.copy(), columns_of(offset)
    evidence[:, -1] = np.hypot(x, y) / max(options.window[0], _LEAST_WINDOW)
    status, outside = np.asarray(match.status), options.is_outside(offset)
    usable = is_usable(column_of(status))
    p_right = chosen(usable & is_not(outside), column_of(probability_right(evidence)), 0.0)
    # Poses outside the window have probability 0.
    doubtful = p_right < chosen(column_of(status) == "converged", DOUBTED, DOUBTED_PARTLY)
    good, p_right = usable & is_not(doubtful), values_of(p_right)
    if all_of(good):
        return match.changed(evidence=evidence, p_right=p_right)
    status = np.where(usable & doubtful, "doubtful", status)
    status = np.where(usable & outside, "outside window", status)
    failed = upright(is_not(good), 2)
    return match.changed(
        evidence=evidence, p_right=p_right, status=status, information=np.where(failed, 0.0, match.information),
        covariance=np.where(failed, np.where(np.eye(3) > 0, np.inf, 0.0), match.covariance),
    )  # fmt: skip


def pair_sums(
    backend: Backend, real: np.dtype, points: ScanPoints, pairs: np.ndarray, options: MatchOptions
) -> np.ndarray:
    """Return results (S, 35) of pairs of scans at their poses, after a single last step."""
    lock, space = space_of(backend)
    stride = options.rules(int(points.counts[pairs[:, 1]].max(initial=0)), points.gap).score_stride
    rules = options.last_rules(points.gap)._replace(score_stride=stride)
    with lock, space:
        device = IcpPairs(backend, real, points, pairs, np.full(len(pairs), options.noise), space)
        result = device.run(np.arange(len(pairs)), np.zeros((len(pairs), 1, 3)), [rules])[:, 0]
    return result


# ---- evidence, and the probability that a pose is right


def pair_evidence(result: np.ndarray, lost: Column, other: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the evidence (S, 9) of results (S, 35), see :data:`NAMES`; ``other`` (S, 3) is NaN without a rival."""
    numbers = columns_of(result)
    weights, squared, seen, through, unseen = numbers[19:24]
    pairs, common = larger(numbers[18], 1.0), larger(seen + through, 1.0)
    rough = square_root(squared / larger(weights, 1e-30)) / larger(column_of(noise), 1e-6)
    values = (
        1 - numbers[3], through / common, seen / larger(common + unseen, 1.0), pairs, smaller(rough, 20.0),
        1 - weights / pairs, lost, has_rival(other), 0.0 * pairs,
    )  # fmt: skip
    return rows_of(values)


def has_rival(other: np.ndarray) -> Column:
    """Return whether there are offsets (S, 3) to other poses: NaN for none."""
    x, y, turn = columns_of(other)
    total = x + y + turn
    return np.isfinite(total) if isinstance(total, np.ndarray) else math.isfinite(total)


def features_of(evidence: np.ndarray) -> list[Column]:
    """Return the ten columns that the weights multiply."""
    logarithms, (lost, rival) = columns_of(np.log(np.maximum(evidence + _NEAR, _LEAST))), columns_of(evidence)[6:8]
    return [*logarithms[:6], lost > 0, lost > 1, rival, logarithms[8]]


def probability_right(evidence: np.ndarray) -> np.ndarray:
    """Return the probabilities (S,) that poses are right along their observed directions."""
    total: Column = _CONSTANT
    for weight, feature in zip(_WEIGHTS, features_of(evidence), strict=True):
        total = total + weight * feature
    return values_of(1 / (1 + np.exp(smaller(-total, _MOST))))


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
    known, sigma, factor = _noise_table()
    deviation, whole = np.interp(ratio, known, sigma), np.interp(ratio, known, factor)
    return (deviation, whole) if isinstance(ratio, np.ndarray) else (float(deviation), float(whole))


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

    ``squares`` are 8 columns: sums of squares of the sums of blocks of 1, 2, 4 to 128 points. The ratio to single
    points rises with the size of blocks, and is less certain for large ones. So its steps are summed until the first
    one that is not positive. The last of them counts twice: once blocks are longer than the correlation, each step is
    half of the one before.
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
    """Return the information that pairs observe, of sums of w J J'; ``doubt`` is noise's part for a unit variance."""
    spurious = [part * variance for part in doubt]
    return observed_information(information, spurious, lever, lines, LEAST_PAIRS, unneeded)


def statuses(result: np.ndarray, lost: Column, step: Column) -> np.ndarray:
    """Return the status of (S, 35) results; ``step`` is the last step along observed directions [deviations]."""
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
