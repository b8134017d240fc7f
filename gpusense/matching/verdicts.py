"""Judge matches: information from their pairs, the directions that they observe, and their status."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gpusense.backends import Backend
from gpusense.matching.evidence import DOUBTED, DOUBTED_PARTLY, probability_right
from gpusense.matching.icp import LONG_WIDTH, WIDTH, IcpPairs, points_of_line, space_of
from gpusense.matching.observability import Observed, axes_of, covariance_of
from gpusense.matching.options import MatchOptions
from gpusense.matching.points import ScanPoints
from gpusense.matching.result import ScanMatch, is_usable
from gpusense.matching.uncertainty import inflation_of, observed_pairs, symmetric, variance_of

# Distances from guesses are relative to windows of at least this [m].
_LEAST_WINDOW = 0.1
# Mean square turn of lines by noise [rad^2] from which longer lines decide which directions are observed.
_TURNED_LINES = 0.05


class PairSums(NamedTuple):
    """Information of pairs in the sensors' frames, variances of points and factors of covariances, for S matches."""

    found: Observed
    variance: np.ndarray
    factor: np.ndarray


def tested(
    device: IcpPairs, result: np.ndarray, points: ScanPoints, pairs: np.ndarray, noise: np.ndarray,
    levels: Sequence[MatchOptions], noisy: np.ndarray,
) -> PairSums:  # fmt: skip
    """Return the directions that pairs observe, by the matches' lines or, where noise may turn these, by longer lines.

    Args:
        device: The pairs.
        result: (S, 35) results of the matches.
        points: The points of all scans.
        pairs: (S, 2) numbers of the reference and of the second scan.
        noise: (S,) standard deviations of ranges [m].
        levels: The options of each level of noise.
        noisy: (N,) numbers of pairs whose lines noise turns.
    """
    lever, weights = points.rms_range(pairs[:, 1]), np.maximum(result[:, 19], 1e-30)
    scale = np.array([options.least_scale for options in levels])[device.level]
    variance, factor = variance_of(result[:, 20] / weights, result[:, 19], scale, noise, inflation_of(result[:, 24:32]))
    largest = np.maximum(variance, noise**2)

    def observed(sums: np.ndarray, rows: np.ndarray | slice, independent: np.ndarray) -> Observed:
        information, doubt = symmetric(sums[:, 6:12]), symmetric(sums[:, 12:18])
        return observed_pairs(information, doubt, largest[rows], lever[rows], independent)

    # Short lines decide only where the result is beyond doubt.
    found = observed(result, slice(None), np.zeros(len(result)))
    turned = (result[:, 12] + result[:, 15]) * largest > _TURNED_LINES * weights
    turned[noisy] = True
    rows = np.flatnonzero(((found.lost > 0) | turned) & (LONG_WIDTH * noise > WIDTH))
    if len(rows):
        device.fit_lines(lambda level: LONG_WIDTH * level, rows)
        strides = [
            options.rules(most, points.gap).stride
            for options, (_, most) in zip(levels, device.most_points(rows), strict=True)
        ]
        rules = [
            options.last_rules(points.gap)._replace(stride=stride, thin=1)
            for options, stride in zip(levels, strides, strict=True)
        ]
        longer = device.run(rows, result[rows, None, :3], rules)[:, 0]
        # A subset represents all points.
        longer[:, 6:18] *= np.array(strides)[device.level[rows], None]
        lines = result[:, 19] / points_of_line(points.gap, noise, lever)
        for values, others in zip(found, observed(longer, rows, lines[rows]), strict=True):
            values[rows] = others
    return PairSums(found, variance, factor)


def concluded(
    pose: np.ndarray, information: np.ndarray, factor: np.ndarray, score: np.ndarray, iterations: np.ndarray,
    status: np.ndarray, lever: np.ndarray, other: np.ndarray, evidence: np.ndarray, pairs: np.ndarray,
    noise: np.ndarray, window: tuple[float, float],
) -> ScanMatch:  # fmt: skip
    """Return matches whose information is 0 where they failed, and spans both poses where there are two.

    Args:
        pose: (S, 3) poses.
        information: (S, 3, 3) information on the poses.
        factor: (S,) factor that turns the information into a sum over pairs [m^2].
        score: (S,) scores.
        iterations: (S,) iterations.
        status: (S,) statuses so far.
        lever: (S,) root mean square ranges [m].
        other: (S, 3) offsets to poses that agree about as well, NaN without one.
        evidence: (S, E) numbers of ``evidence.NAMES``.
        pairs: (S,) sums of weights.
        noise: (S,) standard deviations of ranges [m].
        window: Half widths of the search [m, rad].
    """
    usable = is_usable(status)
    two = usable & np.isfinite(other).all(axis=1)
    if two.any():
        offset = np.where(two[:, None], other, 0.0)
        # The covariance plus a quarter of the offset's square, by Woodbury's identity.
        side = np.einsum("sij,sj->si", information, offset)
        information = information - side[:, :, None] * (side / (4 + (side * offset).sum(axis=1))[:, None])[:, None, :]
        status = np.where(two, "ambiguous", status)
    values, vectors = axes_of(information, lever)
    kept = (values, vectors) if usable.all() else None
    if kept is None:
        # These are not the axes of the information that is kept.
        information = np.where(usable[:, None, None], information, 0.0)
    return ScanMatch(
        pose, covariance_of(information, lever, window, kept), information, np.zeros(len(pose)), score,
        iterations.astype(np.int64), values * (factor / np.maximum(pairs, 1))[:, None], vectors.transpose(0, 2, 1),
        lever, noise, evidence, status,
    )  # fmt: skip


def judged(match: ScanMatch, guess: np.ndarray, options: MatchOptions) -> ScanMatch:
    """Return S matches with their p_right; doubtful matches and matches beyond the window have failed.

    Args:
        match: Matches from ``concluded``.
        guess: (S, 3) guesses of the poses.
        options: The window.
    """
    offset = match.pose - guess
    evidence = match.evidence.copy()
    evidence[:, -1] = np.hypot(offset[:, 0], offset[:, 1]) / max(options.window[0], _LEAST_WINDOW)
    status, outside, usable = np.asarray(match.status), options.is_outside(offset), match.usable
    p_right = np.where(usable & ~outside, probability_right(evidence), 0.0)
    # Poses outside the window have probability 0.
    doubtful = p_right < np.where(status == "converged", DOUBTED, DOUBTED_PARTLY)
    good = usable & ~doubtful
    if good.all():
        return replace(match, evidence=evidence, p_right=p_right)
    status = np.where(usable & doubtful, "doubtful", status)
    status = np.where(usable & outside, "outside window", status)
    failed = ~good[:, None, None]
    return replace(
        match, evidence=evidence, p_right=p_right, status=status, information=np.where(failed, 0.0, match.information),
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
