"""Directions of a pose that the pairs of a match observe, tested against spurious information from noise.

The information of Gauss-Newton counts errors of the lines as information: in a corridor, noise turns lines, and turned
lines seem to constrain the position along it. For a direction v that is not observed, all of v' I v is such a sum of
squares. Its mean is v' S v, where S is the spurious information due to the variance of the points, and it scatters like
a chi-squared variable with as many degrees of freedom as there are lines without a common point. So the generalised
eigenvalues of I v = lambda S v decide: lambda is 1 in the mean where nothing is observed, whatever the units of the
coordinates, and a direction counts as observed above the quantile of lambda with the probability FALSE_ALARM of a false
one.

A lost direction affects all coordinates: the remaining information assumes that the position along it is unknown
(Schur's complement). Where translations alone explain the loss, as along a corridor, the heading stays observed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gpusense.matching.columns import (
    UPPER,
    Column,
    Triangle,
    all_of,
    axes_of_one,
    balanced,
    column_of,
    inverse_of,
    is_definite,
    is_not,
    larger,
    matrices_of,
    square_root,
    triangle_of,
    upright,
    values_of,
)

# Probability that an unobserved direction counts as observed, and the normal quantile of its complement.
FALSE_ALARM, _QUANTILE = 1e-4, 3.72
# Least degrees of freedom, and least ratio of an observed direction.
_LEAST_LINES, _LEAST_RATIO = 4.0, 2.0
# Least number of pairs that observe a direction.
LEAST_PAIRS = 1.5
# Spurious information attributed to lines without errors [pairs].
_SPURIOUS = 1e-3
# Share of the largest eigenvalue below which a direction of an information is lost.
_NOTHING = 1e-9


class Observed(NamedTuple):
    """Information of pairs."""

    information: Triangle  # sums of w J J' without the part that noise makes up, 0 along lost directions up to rounding
    lost: Column  # number of lost directions

    def replaced(self, rows: np.ndarray, others: Observed) -> Observed:
        """Return the information with that of some rows replaced; a single match is replaced as a whole."""
        if not isinstance(self.lost, np.ndarray):
            return others
        information, lost = np.array(self.information), np.array(self.lost)
        information[:, rows], lost[rows] = [*map(values_of, others.information)], others.lost
        return Observed([*information], lost)


def critical_ratio(lines: Column) -> Column:
    """Return the quantile of a chi-squared variable over its degrees of freedom, by Wilson and Hilferty (1931)."""
    share = 2 / (9 * larger(lines, _LEAST_LINES))
    root = 1 - share + _QUANTILE * square_root(share)
    return larger(root * root * root, _LEAST_RATIO)


_RATIO_OF_FEW_LINES: float = critical_ratio(_LEAST_LINES)


def observed_information(
    information: Triangle, spurious: Triangle, lever: Column, lines: Column | None, least: Column,
    unneeded: Column = False,
) -> Observed:  # fmt: skip
    """Remove from the information of pairs, sums of w J J', the directions that they do not observe.

    ``spurious`` is the expected part due to the variance of the points; ``lever`` converts headings to distances [m];
    ``lines`` of the scan have no common point, None for few; an observed direction has at least ``least`` pairs.
    Matches in ``unneeded`` need no information if they lose a direction; their number of these may then be 1.
    """
    total = balanced(information, lever)
    made_up = _with_diagonal(balanced(spurious, lever), _SPURIOUS, _SPURIOUS)
    critical = _RATIO_OF_FEW_LINES if lines is None else critical_ratio(lines)
    # All directions are observed where I exceeds S times the critical ratio, and the least number of pairs.
    beyond = is_definite([whole - critical * part for whole, part in zip(total, made_up, strict=True)])
    clear = beyond & is_definite(_with_diagonal(total, -least, -least))
    # Then noise contributes S.
    less = [whole - part for whole, part in zip(information, spurious, strict=True)]
    left = _with_diagonal(less, -_SPURIOUS, -_SPURIOUS * (lever * lever))
    if all_of(clear):
        return Observed(left, np.zeros(len(clear), np.intp) if isinstance(clear, np.ndarray) else 0)
    skipped = values_of(unneeded & is_not(beyond))
    count, rows = len(skipped), np.flatnonzero(is_not(clear | skipped))
    if not len(rows):
        return Observed(left, column_of(skipped.astype(np.intp)))
    some, noise = (matrices_of([values_of(column)[rows] for column in triangle]) for triangle in (total, made_up))
    found, lost = _partly_observed(some, noise, *(np.broadcast_to(limit, count)[rows] for limit in (critical, least)))
    # The test on pairs is strict, so some matches have no lost direction.
    gone, rows = lost > 0, rows[lost > 0]
    parts, numbers = np.array([*map(values_of, left)]), skipped.astype(np.intp)
    parts[:, rows] = balanced([*found[gone].reshape(-1, 9).T[UPPER]], 1 / values_of(lever)[rows])
    numbers[rows] = lost[gone]
    return Observed([*map(column_of, parts)], column_of(numbers))


def _with_diagonal(triangle: Triangle, place: Column, heading: Column) -> Triangle:
    """Return matrices with numbers added to the diagonal: the first for x and y, the second for the heading."""
    xx, xy, xt, yy, yt, tt = triangle
    return xx + place, xy, xt, yy + place, yt, tt + heading


def _partly_observed(
    total: np.ndarray, made_up: np.ndarray, critical: np.ndarray, least: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the observed part (L, 3, 3) of information with noise ``made_up``, and the lost directions (L,)."""
    values, vectors = _generalised(total, made_up)
    lost = _is_lost(values, vectors, critical, least)
    count = lost.sum(axis=1)
    some = np.flatnonzero(lost[:, 0])
    if len(some):
        basis = _lost_basis(total[some], made_up[some], critical[some], least[some], vectors[some], lost[some])
        rest = without(total[some], basis, made_up[some])
        values[some], vectors[some] = _generalised(rest, made_up[some])
    # Noise contributes 1 to each eigenvalue.
    left = np.where(np.arange(3) < count[:, None], 0.0, np.maximum(values - 1, 1e-3 * values))
    sides = made_up @ vectors
    result = np.einsum("sik,sk,sjk->sij", sides, left, sides)
    if len(some):
        result[some] = without(result[some], basis, made_up[some])
    return result, count


def balance_of(lever: Column) -> np.ndarray:
    """Return (S, 3) factors that turn x, y and ``lever`` times the heading into x, y and the heading."""
    if not isinstance(lever, np.ndarray):
        return np.array([[1.0, 1.0, 1 / lever]])
    factors = np.ones((len(lever), 3))
    factors[:, 2] = 1 / lever
    return factors


def without(information: np.ndarray, lost: np.ndarray, made_up: np.ndarray) -> np.ndarray:
    """Return information (S, 3, 3) with the positions along lost directions (S, 3, L) unknown; columns may be 0."""
    side = information @ lost
    inner = lost.transpose(0, 2, 1) @ (side + made_up @ lost)
    left = information - side @ np.linalg.pinv(inner, rcond=1e-12, hermitian=True) @ side.transpose(0, 2, 1)
    # Rounding leaves traces along lost directions: project them out.
    q = orthonormal(lost)
    keep = np.eye(3) - q @ q.transpose(0, 2, 1)
    result: np.ndarray = keep @ left @ keep
    return result


def _generalised(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ascending eigenvalues (S, 3) of a v = lambda b v, and eigenvectors in columns with v' b v = 1."""
    inverse = np.linalg.inv(np.linalg.cholesky(b))
    turned = inverse.transpose(0, 2, 1)
    values, vectors = np.linalg.eigh(inverse @ a @ turned)
    return values, turned @ vectors


def _is_lost(values: np.ndarray, vectors: np.ndarray, critical: Column, least: Column) -> np.ndarray:
    """Return which directions noise explains or hardly a pair observes, and all directions with smaller ratios."""
    pairs = values / np.maximum(np.add.reduce(np.square(vectors), axis=1), 1e-300)
    lost = (values < upright(critical)) | (pairs < upright(least))
    for k in range(lost.shape[1] - 1, 0, -1):
        lost[:, k - 1] |= lost[:, k]
    return lost


def _lost_basis(
    total: np.ndarray, made_up: np.ndarray, critical: np.ndarray, least: np.ndarray, vectors: np.ndarray,
    lost: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Return (S, 3, 3) lost directions in columns, further columns 0; first pure translations that are lost."""
    values, plane = _generalised(total[:, :2, :2], made_up[:, :2, :2])
    slides = _is_lost(values, plane, critical, least)
    basis = np.where(lost[:, None, :], vectors, 0.0)
    basis /= np.maximum(np.linalg.norm(basis, axis=1, keepdims=True), 1e-300)
    count, sliding = lost.sum(axis=1), slides.sum(axis=1)
    translation = np.concatenate([plane, np.zeros((len(plane), 1, 2))], axis=1)
    translation /= np.linalg.norm(translation, axis=1, keepdims=True)
    one = (count == 1) & (sliding >= 1)
    basis[one, :, 0] = translation[one, :, 0]
    two = (count == 2) & (sliding == 2)
    basis[two, :, :2] = np.eye(3)[:, :2]
    # Given a translation, choose the direction less parallel to it.
    mixed = np.flatnonzero((count == 2) & (sliding == 1))
    if len(mixed):
        along = np.abs(np.einsum("si,sik->sk", translation[mixed, :, 0], basis[mixed, :, :2]))
        other = basis[mixed, :, np.argmin(along, axis=1)]
        basis[mixed, :, 0], basis[mixed, :, 1] = translation[mixed, :, 0], other
    basis[count == 3] = np.eye(3)
    return basis


def spanning(information: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Return information (S, 3, 3) that also spans poses at offsets (S, 3), by Woodbury's identity; NaN: no such pose.

    The covariance grows by a quarter of the offset's square.
    """
    offset = np.where(np.isfinite(offset), offset, 0.0)
    side = np.einsum("sij,sj->si", information, offset)
    total = 4 + (side * offset).sum(axis=1)
    result: np.ndarray = information - side[:, :, None] * (side / total[:, None])[:, None, :]
    return result


def orthonormal(vectors: np.ndarray) -> np.ndarray:
    """Return orthonormal columns that span those of (S, 3, L); columns without a direction are 0."""
    u, s, _ = np.linalg.svd(vectors, full_matrices=False)
    kept = s > 1e-9 * np.maximum(s[:, :1], 1e-300)
    result: np.ndarray = np.where(kept[:, None, :] & (s[:, None, :] > 0), u, 0.0)
    return result


def axes_of(information: np.ndarray, lever: Column) -> tuple[np.ndarray, np.ndarray]:
    """Return ascending eigenvalues (S, 3) of information, 0 where lost, and directions (S, 3, 3) in columns."""
    if not isinstance(lever, np.ndarray):
        # Where nothing is lost, the axes do not depend on rounding.
        axes = axes_of_one(balanced(triangle_of(information), lever))
        if axes[0][0] > _NOTHING * axes[2][0]:
            sizes, rows = zip(*axes, strict=True)
            return np.array([sizes]), np.array([rows]).transpose(0, 2, 1)
    scale = balance_of(lever)
    values, vectors = np.linalg.eigh(information * (scale[:, :, None] * scale[:, None, :]))
    least, largest = column_of(values[:, 0]), column_of(values[:, -1])
    if not all_of(least > _NOTHING * larger(largest, 0.0)):
        values = np.where(values > _NOTHING * np.maximum(values[:, -1:], 0), values, 0.0)
    return values, vectors


def covariance_of(
    information: np.ndarray, lever: Column, reach: tuple[float, float],
    known_axes: tuple[np.ndarray, np.ndarray] | None = None,
) -> np.ndarray:  # fmt: skip
    """Return the covariance (S, 3, 3) of an information: its inverse, infinite in every coordinate that is lost.

    A coordinate is lost if positions along a lost direction within ``reach`` [m, rad] of each other differ in it by
    more than its deviation; where they differ less, their difference is part of its variance. ``lever`` converts
    headings to distances [m]; ``known_axes`` is the result of ``axes_of``.
    """
    values, vectors = axes_of(information, lever) if known_axes is None else known_axes
    # In ascending order, with lost ones first.
    seen = column_of(values[:, 0]) > 0
    if all_of(seen):
        return matrices_of(inverse_of(triangle_of(information)))
    covariance, rows = np.empty(information.shape), np.flatnonzero(seen)
    if len(rows):
        covariance[rows] = matrices_of(inverse_of([*information.reshape(-1, 9)[rows].T[UPPER]]))
    rows = np.flatnonzero(is_not(seen))
    axes = vectors[rows] * balance_of(lever)[rows, :, None]
    covariance[rows] = _partly_known(values[rows], axes, reach)
    return covariance


def _partly_known(values: np.ndarray, axes: np.ndarray, reach: tuple[float, float]) -> np.ndarray:
    """Return the covariance (L, 3, 3) of eigenvalues (L, 3) of an information, some of them 0, and axes in columns."""
    gone = values == 0
    inverse = np.where(gone, 0, 1 / np.where(gone, 1, values))
    covariance = np.einsum("sik,sk,sjk->sij", axes, inverse, axes)
    lost = np.where(gone[:, None, :], axes, 0.0)
    # Largest move along each lost direction within reach, and the change of each coordinate by it.
    limit = np.array([max(reach[0], 1e-3), max(reach[0], 1e-3), max(reach[1], 1e-3)])
    with np.errstate(divide="ignore"):
        far = np.min(np.where(np.abs(lost) > 0, limit[:, None] / np.abs(lost), np.inf), axis=1)
    moved = np.sqrt(np.square(np.where(gone[:, None, :], lost * np.where(gone, far, 0)[:, None, :], 0)).sum(axis=2))
    variance = np.einsum("sii->si", covariance)
    infinite = moved**2 > variance
    covariance[:, range(3), range(3)] += np.where(infinite, 0, moved**2)
    with np.errstate(invalid="ignore"):
        product = lost @ lost.transpose(0, 2, 1)
        size = np.sqrt(np.einsum("sii->si", product))
        both = infinite[:, :, None] & infinite[:, None, :] & (
            np.abs(product) > 1e-6 * size[:, :, None] * size[:, None, :]
        )  # fmt: skip
    covariance = np.where(both, np.copysign(np.inf, product), covariance)
    covariance[:, range(3), range(3)] = np.where(infinite, np.inf, np.einsum("sii->si", covariance))
    return covariance
