"""Compute the temperature of a scan's log-likelihood: the weight that equates curvature and variance of the score.

The product over a scan's beams treats them as independent, but an error of the map, or a person, changes many
neighbours. Let s_k be the score of beam k, the gradient of its log-likelihood with respect to the pose, H the sum of
the negative second derivatives, J the variance of the sum of the s_k, and P the covariance of the pose. A likelihood
has J = H (Bartlett's second identity), so T = tr(P H) / tr(P J) (Pauli, Racugno and Ventura, "Bayesian composite
marginal likelihoods" (2011); Ribatet, Cooley and Davison, "Bayesian inference from composite likelihoods" (2012)).

J is measured over blocks of neighbours with scores g_b. Let B be the sum of s_k s_k', and B_b its part in a block. A
fit to the scan removes B_b B^-1 of the sum of all scores from g_b, and leaves the variance B_b - B_b B^-1 B_b for
independent beams. F_n is the measured variance of n blocks relative to this value. Errors of maps are correlated over
any length (aggregated variance: Beran, *Statistics for Long-Memory Processes* (1994), section 4.4), so let the
inflations of sixteenths, quarters and the whole be V, x V and x^2 V. The fit removes the part common to all blocks:
F_16 = (V - x^2 V / 16) / (1 - 1 / 16) and F_4 = (x V - x^2 V / 4) / (1 - 1 / 4). Let R = F_4 / F_16, at most 5/3. Then
x is 4 R / (5 - R), and x^2 V = F_4 3 R / (5 - 2 R).

Errors that repeat from scan to scan, with a correlation r in the same direction and a share f of information that the
filter keeps, have (1 + r f) / (1 - r f) times the variance; the inverse is the second factor of the temperature.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from gpusense._util import checks
from gpusense._util.typing import AnyArray
from gpusense.matching.columns import axes_of_one
from gpusense.models.scan.model import ScanModel
from gpusense.world.pose_algebra import rotations

# Independent beams of a scan before any data.
INDEPENDENT_AT_FIRST = 10.0
# Fewest independent beams of a scan, largest correlation of consecutive scans, and largest growth R.
INDEPENDENT_AT_LEAST, _LARGEST_REPEAT, _LARGEST_GROWTH = 1.0, 0.9, 5 / 3
# Number of scans for weights to fall to 1 / e; least scans for an estimate; least beams of a scan.
_MEMORY, _LEAST_SCANS, _FEWEST = 40, 5, 8
# Significance of an excess variance of blocks [deviations].
_SIGNIFICANT = 2.0
# Numbers of long blocks, of short blocks, and of sectors for comparing scans.
_LONG, _SHORT, _SECTORS = 4, 16, 8
# Least and largest steps [m], and radians per metre.
_STEPS, _TURN = (1e-4, 0.1), 0.25
# Deviations from the pose to the points of a cubature of degree 3 in 3 dimensions (Arasaratnam and Haykin, "Cubature
# Kalman filters" (2009)): differences are means of derivatives over the normal density of the pose.
_FAR = 3**0.5
# Rows of a beam's numbers: three scores, their six products (by both factors), and 1; rows of the matrix of products.
_ROWS = 10
_FIRST, _SECOND = np.array([0, 0, 0, 1, 1, 2]), np.array([0, 1, 2, 1, 2, 2])
_OUTER, _BEGINS = np.array([[3, 4, 5], [4, 6, 7], [5, 7, 8]]), np.arange(_ROWS)[:, None]
# Initial steps without a known covariance: ahead, to the side [m] and in heading [rad].
_FIRST_STEPS = (0.05, 0.05, 0.0125)


def axes_of(covariance: np.ndarray) -> np.ndarray:
    """Return steps as columns of a (3, 3) array: deviations along the axes of a (3, 3) covariance, 0.1 mm to 10 cm."""
    (xx, xy, xt), (_, yy, yt), (_, _, tt) = covariance.tolist()
    steps = []
    # A few numbers of Python take a fraction of the time of LAPACK between steps of a filter.
    for variance, (x, y, theta) in axes_of_one((xx, xy, xt / _TURN, yy, yt / _TURN, tt / _TURN**2)):
        length = min(max(math.sqrt(max(variance, 0.0)), _STEPS[0]), _STEPS[1])
        steps.append((length * x, length * y, length * _TURN * theta))
    return np.array(steps).T


def poses_around(pose: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return the (7, 3) poses for measuring scores: the pose, and steps forward and back along each axis."""
    poses, steps = np.empty((7, 3)), _FAR * axes.T
    poses[:] = pose
    poses[1:4] += steps
    poses[4:] -= steps
    return poses


class TaughtScan(NamedTuple):
    """A scan that teaches the temperature, after some ``PARTS`` of the computation."""

    values: np.ndarray  # (7, K) log-likelihoods of beams at poses_around the pose; later (10, K) scores and products
    axes: np.ndarray  # (3, 3) axes of these poses
    directions: np.ndarray  # (K,) directions of the beams in the world [rad]
    around: int  # number of sectors of the world for comparing scans; 0 without directions
    follows: bool = True  # whether the scan directly follows the last one
    curvature: float = 0.0  # negative second derivatives of the log-likelihood, summed over the axes
    # (10, B) sums of three scores, their six products, and 1, over short blocks, long blocks, and sectors of the world.
    sums: np.ndarray = np.empty((_ROWS, 0))
    # (3, B) sums of scores after a fit of the pose, (3, 3) inverse of the products' sum, (3, 3, B) products.
    fit: tuple[np.ndarray, ...] = ()
    trace: float = 0.0  # sum of the squared scores
    # Variances of long blocks, measured and if independent, and the same of short blocks.
    variances: tuple[float, ...] = ()


def _use_beams(scan: TaughtScan) -> TaughtScan | None:
    """Drop beams with 0 or a non-finite value; return None if too few are left."""
    values = scan.values
    used = np.isfinite(values).all(axis=0) & values.any(axis=0)
    count = int(np.count_nonzero(used))
    if count < _FEWEST:
        return None
    return scan if count == len(used) else scan._replace(values=values[:, used], directions=scan.directions[used])


def _score(scan: TaughtScan) -> TaughtScan:
    """Compute scores and curvature of the used beams."""
    parts, rows = scan.values, np.ones((_ROWS, scan.values.shape[1]))
    at, *around = parts.sum(axis=1).tolist()
    np.subtract(parts[1:4], parts[4:], out=rows[:3])
    rows[:3] /= 2 * _FAR
    np.multiply(rows[_FIRST], rows[_SECOND], out=rows[3:9])
    return scan._replace(values=rows, curvature=(6 * at - sum(around)) / _FAR**2)


def _add_blocks(scan: TaughtScan) -> TaughtScan:
    """Sum over blocks of neighbours."""
    short = _sums_of(scan.values, _neighbors(scan.values.shape[1]), _SHORT)
    return scan._replace(sums=np.concatenate([short, short.reshape(_ROWS, _LONG, -1).sum(axis=2)], axis=1))


def _add_sectors(scan: TaughtScan) -> TaughtScan:
    """Sum over sectors of the world."""
    if not scan.around:
        return scan
    sector = np.floor(scan.directions * (scan.around / math.tau)).astype(np.int64) % scan.around
    return scan._replace(sums=np.concatenate([scan.sums, _sums_of(scan.values, sector, scan.around)], axis=1))


def _fit(scan: TaughtScan) -> TaughtScan:
    """Fit the pose, and remove its part from the sums of scores."""
    *scores, xx, xy, xt, yy, yt, tt, _ = scan.sums[:, :_SHORT].sum(axis=1).tolist()
    least = 1e-9 * max(xx + yy + tt, 1e-30)
    inverse = _inverse_of(((xx + least, xy, xt), (xy, yy + least, yt), (xt, yt, tt + least)))
    outer = scan.sums[_OUTER]
    fitted = scan.sums[:3] - np.einsum("ijb,j->ib", outer, (inverse * scores).sum(axis=1))
    return scan._replace(fit=(fitted, inverse, outer), trace=xx + yy + tt + 3 * least)


def _find_variances(scan: TaughtScan) -> TaughtScan:
    """Compute the variances of blocks, measured and if independent."""
    (fitted, inverse, outer), end = scan.fit, _SHORT + _LONG
    measured = (fitted * fitted).sum(axis=0).tolist()
    removed = np.einsum("ijb,jk,kib->b", outer[..., :end], inverse, outer[..., :end]).tolist()
    long, short = scan.trace - sum(removed[_SHORT:]), scan.trace - sum(removed[:_SHORT])
    return scan._replace(variances=(sum(measured[_SHORT:end]), long, sum(measured[:_SHORT]), short))


PARTS = (_use_beams, _score, _add_blocks, _add_sectors, _fit, _find_variances)
"""Parts of the computation of a scan's variances, each short enough for a wait of a filter's step."""


def sectors_of(directions: np.ndarray) -> int:
    """Return the number of sectors per turn, each an eighth of a scan with beams in (K,) directions [rad]."""
    ordered = np.sort(np.mod(directions, math.tau))
    gap = max(float(np.max(ordered[1:] - ordered[:-1])), float(ordered[0] + math.tau - ordered[-1]))
    return max(round(_SECTORS * math.tau / max(math.tau - gap, 0.1)), 1)


def _sums_of(rows: np.ndarray, block: np.ndarray, blocks: int) -> np.ndarray:
    """Return (R, B) sums of rows (R, K) over blocks (K,)."""
    places = _BEGINS * blocks + block
    return np.bincount(places.reshape(-1), rows.reshape(-1), _ROWS * blocks).reshape(_ROWS, blocks)


@functools.lru_cache(maxsize=64)
def _neighbors(beams: int) -> np.ndarray:
    """Return the short block of each beam; four of them are a long block."""
    return np.arange(beams) * _SHORT // beams


def _inverse_of(matrix: Sequence[Sequence[float]]) -> np.ndarray:
    """Return the inverse of a (3, 3) matrix by its cofactors."""
    (a, b, c), (d, e, f), (g, h, i) = matrix
    one, two, three = e * i - f * h, f * g - d * i, d * h - e * g
    cofactors = [
        (one, c * h - b * i, b * f - c * e), (two, a * i - c * g, c * d - a * f), (three, b * g - a * h, a * e - b * d),
    ]  # fmt: skip
    return np.array(cofactors) / (a * one + b * two + c * three)


def _mixed(one: np.ndarray, other: np.ndarray, keep: float) -> np.ndarray:
    """Return a running mean ``one`` after adding ``other``."""
    return keep * one + (1 - keep) * other


class BeamCorrelation:
    """Running variance of scans' scores, for the effective number of independent beams."""

    def __init__(self) -> None:
        self.scans = 0
        # Running means of scans: curvature; variance for independent beams; variances of long blocks, measured and for
        # independent beams; the same for short blocks; share of a pose's information that a scan contributes; beams.
        self._means = np.zeros(8)
        # Products and squares of consecutive scans, and their number.
        self._products, self._pairs = np.zeros(2), 0
        # Gradients in sectors of the world of the last scan, and the sectors with beams.
        self._previous: tuple[np.ndarray, np.ndarray] | None = None

    def add(self, parts: AnyArray, axes: AnyArray, directions: AnyArray | None = None, *, follows: bool = True) -> None:
        """Add a scan: (7, K) log-likelihoods of beams at :func:`poses_around` the pose, by bearing, with (3, 3) axes.

        Beams with 0 or a non-finite value are ignored. Directions (K,) in the world [rad] serve to compare a scan with
        the previous one if it ``follows`` directly.
        """
        values = checks.array("parts", parts, (7, "K"), finite=False)
        steps, count = checks.array("axes", axes, (3, 3)), values.shape[1]
        ways = np.zeros(count) if directions is None else checks.array("directions", directions, (count,))
        around = sectors_of(ways) if directions is not None and count >= _FEWEST else 0
        scan: TaughtScan | None = TaughtScan(values, steps, ways, around, follows)
        for part in PARTS:
            scan = None if scan is None else part(scan)
        self.learn(scan)

    def learn(self, scan: TaughtScan | None) -> None:
        """Add a scan after all ``PARTS``, or None for a scan with too few beams."""
        if scan is None:
            self._previous = None
            return
        count = scan.values.shape[1]
        gain = min(max(self.temperature(count) * scan.curvature / 3, 0.0), 1.0)
        found = (scan.curvature, scan.trace * count / (count - 3), *scan.variances, gain, count)
        self._means = _mixed(self._means, np.array(found), 1 - 1 / min(self.scans + 1, _MEMORY))
        self.scans += 1
        if scan.around:
            end = _SHORT + _LONG
            self._compare(scan.fit[0][:, end:], scan.sums[9, end:] > 0, scan.axes, scan.follows)

    def _compare(self, now: np.ndarray, seen: np.ndarray, axes: np.ndarray, follows: bool) -> None:
        """Correlate (3, A) scores of the sectors of a scan, and which have beams, with the last scan's."""
        if follows and self._previous is not None and len(self._previous[1]) == len(seen):
            then = np.einsum("ji,jt->it", axes, self._previous[0])
            squares = ((now * now + then * then) * (seen & self._previous[1])).sum() / 2
            found = np.array([(now * then).sum(), squares])
            self._products = _mixed(self._products, found, 1 - 1 / min(self._pairs + 1, _MEMORY))
            self._pairs += 1
        # Gradients in the world, times this scan's root of the covariance.
        self._previous = np.einsum("ji,jt->it", _inverse_of(axes.tolist()), now), seen

    @property
    def beams(self) -> float:
        """Mean number of used beams of a scan."""
        return float(self._means[7])

    @property
    def repeat(self) -> float:
        """Correlation r of the scores of consecutive scans in the same directions, 0 to 0.9."""
        if self._pairs < _LEAST_SCANS or not self._products[1] > 0:
            return 0.0
        return min(max(float(self._products[0] / self._products[1]), 0.0), _LARGEST_REPEAT)

    @property
    def kept(self) -> float:
        """Share f of a pose's information that precedes the scan, 0 to 1."""
        return 1 - float(self._means[6]) if self.scans else 0.0

    @property
    def inflation(self) -> float:
        """Variance of the sum over a scan, relative to independent beams; at least 1."""
        long, long_wanted, short, short_wanted = self._means[2:6].tolist()
        if not (long_wanted > 0 and short_wanted > 0 and short > 0):
            return 1.0
        quarters, sixteenths = long / long_wanted, short / short_wanted
        # Deviations of the ratios for independent beams, with at least one degree of freedom per block.
        scans = min(self.scans, 2 * _MEMORY - 1)
        unsure, less = (_SIGNIFICANT * math.sqrt(2 / ((blocks - 1) * scans)) for blocks in (_LONG, _SHORT))
        if quarters <= 1 + unsure and sixteenths <= 1 + less:
            return 1.0
        growth = quarters / sixteenths
        growth = min(growth, _LARGEST_GROWTH) if growth > 1 + unsure else 1.0
        return max(quarters * 3 * growth / (5 - 2 * growth), 1.0)

    def temperature(self, beams: int) -> float:
        """Return the temperature of a sensor with ``beams`` used beams from its scans, or an initial one."""
        count = checks.integer("beams", beams, low=0)
        curvature, independent = self._means[:2].tolist()
        if self.scans < _LEAST_SCANS or not independent > 0:
            return min(1.0, INDEPENDENT_AT_FIRST / max(count, 1))
        repeated = self.repeat * self.kept
        found = (1 - repeated) / (1 + repeated) * curvature / (independent * self.inflation)
        return min(1.0, max(found, INDEPENDENT_AT_LEAST / max(count, 1)))


def learn_from_scan(correlation: BeamCorrelation, model: Any, ranges: AnyArray, pose: AnyArray) -> None:
    """Add a scan (K,) at a (3,) pose; this scan and the present temperature determine the covariance."""
    at, count = checks.array("pose", pose, (3,)), model.used_beams
    turn, first = rotations(at[2]), np.array(_FIRST_STEPS)
    parts = _parts(model, poses_around(at, turn * first), ranges)
    parts = np.where(np.isfinite(parts).all(axis=0), parts, 0.0)
    curvature = np.maximum((2 * parts[0] - parts[1:4] - parts[4:7]).sum(axis=1), 0.0) / (_FAR * first) ** 2
    information = correlation.temperature(count) * curvature + (np.array([1.0, 1.0, 1 / _TURN]) / _STEPS[1]) ** 2
    axes = axes_of((turn / information) @ turn.T)
    correlation.add(_parts(model, poses_around(at, axes), ranges), axes)


def _parts(model: Any, poses: np.ndarray, ranges: AnyArray) -> np.ndarray:
    return np.asarray(model.log_likelihood(poses, ranges, per_beam=True)[1], np.float64)


def calibrate_temperature(model: Any, scans: AnyArray, poses: AnyArray) -> float:
    """Return the temperature of a log's scans, each judged separately.

    A filter with ``temperature="auto"`` measures it, and lowers it further if errors repeat from scan to scan.

    Args:
        model: A :class:`BeamModel` or :class:`LikelihoodFieldModel`.
        scans: (S, K) ranges [m], S >= 5.
        poses: (S, 3) poses of the robot at the scans, from a tracker or a reference [m, m, rad].

    Raises:
        TypeError: ``model`` is no model of scans, or an argument is no array.
        ValueError: fewer than five scans have eight beams with a log-likelihood, or the number of poses differs.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> grid = gs.OccupancyGrid(np.pad(np.zeros((30, 40), int), 1, constant_values=100), resolution=0.1)
        >>> model = gs.BeamModel(grid, gs.Scanner(np.arange(-3.1, 3.1, 0.05), range_max=9.0), backend="numpy")
        >>> poses, noise = np.tile((2.0, 1.5, 0.3), (20, 1)), np.random.default_rng(0).normal(0, 0.05, (20, 124))
        >>> scans = gs.RayCaster(grid, range_max=9.0, backend="numpy").cast(poses, model.scanner.bearings) + noise
        >>> 0.3 < gs.calibrate_temperature(model, scans, poses) <= 1
        True
    """
    if not isinstance(model, ScanModel):
        raise TypeError(f"model: must be a model of scans, got {checks.show(model)}")
    at = checks.array("poses", poses, ("S", 3))
    readings = checks.array("scans", scans, (len(at), model.scanner.count), finite=False, dtype=None)
    if len(at) < _LEAST_SCANS:
        raise ValueError(f"scans: must be at least {_LEAST_SCANS}, got {len(at)}")
    correlation = BeamCorrelation()
    for ranges, pose in zip(readings, at, strict=True):
        learn_from_scan(correlation, model, ranges, pose)
    if correlation.scans < _LEAST_SCANS:
        rule = f"at least {_LEAST_SCANS} must have {_FEWEST} beams that the model uses"
        raise ValueError(f"scans: {rule}, got {correlation.scans} of {len(at)}")
    return correlation.temperature(model.used_beams)
