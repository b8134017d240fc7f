"""Learn the causes of the discrete model by maximum likelihood, from counts of (step of z*, step of z)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from gpusense._util import checks
from gpusense._util.typing import Floats, Integers
from gpusense.learning.discrete.probabilities import (
    MOST_BINS,
    DiscreteCauses,
    DiscreteFit,
    bins_of,
    check_pairs,
    separate_causes,
)
from gpusense.learning.information import errors_of, notes_on_blocks, number_blocks, scatter_of

NAMES = ("lambda_short", "lambda_rand", "p_detect", "sigma_hit")
# Steps of first and second central differences of the mean log-likelihood; they balance rounding and truncation
# errors.
_FIRST, _SECOND = 1e-5, 1e-3
# Largest gradient of the mean log-likelihood that counts as 0: with ten million readings it moves a parameter by less
# than a hundredth of its standard error.
_FLAT = 2e-6
# Number of beam steps of the coarse search in front of a search with many.
_FEW = 100
# Number of starts to follow; restarts of a search that ends before the gradient vanishes.
_BEST, _RESTARTS = 3, 3
# Information below this share of the largest, scaled to a diagonal of 1, counts as none.
_FLAT_SHARE = 1e-6
# Number of readings per pass.
_BLOCK = 1 << 20


def learn_causes(
    ranges: object, expected: object, range_max: float, bins: int, blocks: object = None
) -> tuple[DiscreteCauses, DiscreteFit]:
    """Learn the most likely causes; see ``DiscreteBeamModel.learn``.

    A quasi-Newton search moves the logarithms of rates and sigma_hit and the log odds of detection, within bounds
    beyond which the table does not change. It follows the best of several starts, and returns the highest end. For many
    beam steps, coarse searches provide further starts.
    """
    data = count_pairs(ranges, expected, range_max, bins)
    labels = None if blocks is None else _block_counts(data, ranges, expected, float(range_max), blocks)
    starts = _starts(data)
    if bins > 2 * _FEW:
        coarse = data.coarser(_FEW)
        for start in _starts(coarse)[:_BEST]:
            theta = _search(coarse, start)[1]
            theta[3] = max(theta[3], math.log(0.2 * data.width))
            starts.append(theta)
        starts.sort(key=lambda theta: _loss(data, theta))
    value, theta, trace = min((_search(data, start) for start in starts[:_BEST]), key=lambda result: result[0])
    return _causes(theta), _fit(data, value, theta, trace, labels)


def _block_counts(data: Counts, ranges: object, expected: object, range_max: float, blocks: object) -> Integers:
    """Return the (3, E) block, index among the counts, and number of readings of all occupied cells."""
    z, z_exp = (
        checks.as_array(name, value, masked=True) for name, value in (("ranges", ranges), ("expected", expected))
    )
    readings, expected_ranges = check_pairs(z.ravel(), z_exp.ravel(), range_max)
    i, j = (bins_of(each, range_max, data.bins) for each in (readings, expected_ranges))
    known = i >= 0
    numbers = number_blocks(blocks, z.shape, known)
    assert numbers is not None
    cells = np.searchsorted(data.rows * (data.bins + 1) + data.steps, j[known] * (data.bins + 1) + i[known])
    both, times = np.unique(np.stack([numbers, cells]), axis=1, return_counts=True)
    return np.vstack([both, times])


def _block_scatter(data: Counts, theta: Floats, places: Integers, labels: Integers) -> Floats:
    """Return the (m, m) scatter of the gradient over blocks by some coordinates of the search."""
    block, cell, times = labels
    slopes = []
    for step in (_FIRST * np.eye(len(theta)))[places]:
        ends = [separate_causes(data.bins, data.width, **_causes(theta + sign * step).to_dict(), rows=data.rows,
                                steps=data.steps) for sign in (1, -1)]  # fmt: skip
        slope = (ends[0] - ends[1]) / (2 * _FIRST)
        slopes.append(np.bincount(block, times * slope[cell]))
    return scatter_of(np.array(slopes, np.float64).reshape(len(places), -1).T)


def _search(data: Counts, start: Floats) -> tuple[float, Floats, list[float]]:
    """Minimise the mean negative log-likelihood; return its minimum, the point, and the trace."""
    trace = [_loss(data, start)]
    for _ in range(_RESTARTS):
        result = minimize(
            lambda theta: _loss(data, theta), start, jac=lambda theta: _gradient(data, theta), method="L-BFGS-B",
            bounds=_bounds(data), callback=lambda theta: trace.append(_loss(data, theta)),
            options={"maxiter": 300, "ftol": 0.0, "gtol": 0.1 * _FLAT},
        )  # fmt: skip
        start = np.array(result.x)
        if _is_flat(data, start):
            break
    return float(result.fun), start, trace


def _pushed(data: Counts, theta: Floats) -> tuple[Floats, NDArray[np.bool]]:
    """Return the gradient, and the mask of parameters at a bound beyond which the likelihood rises."""
    low, high = np.transpose(_bounds(data))
    slope = _gradient(data, theta)
    return slope, ((theta <= low + 1e-9) & (slope > 0)) | ((theta >= high - 1e-9) & (slope < 0))


def _is_flat(data: Counts, theta: Floats) -> bool:
    """Return whether the gradient vanishes within the bounds."""
    slope, pushed = _pushed(data, theta)
    return bool((np.abs(slope)[~pushed] <= _FLAT).all())


def _loss(data: Counts, theta: Floats) -> float:
    return -data.log_likelihood(_causes(theta)) / data.total


def _gradient(data: Counts, theta: Floats) -> Floats:
    steps = _FIRST * np.eye(len(NAMES))
    return np.array([(_loss(data, theta + step) - _loss(data, theta - step)) / (2 * _FIRST) for step in steps])


def _fit(data: Counts, value: float, theta: Floats, trace: list[float], labels: Integers | None) -> DiscreteFit:
    low, high = np.transpose(_bounds(data))
    at_low, at_high = theta <= low + 1e-9, theta >= high - 1e-9
    converged = _is_flat(data, theta)
    free = ~(at_low | at_high)
    independent = _standard_errors(data, theta, free)
    errors = independent if labels is None else _standard_errors(data, theta, free, labels)
    blocks = 0 if labels is None else int(labels[0].max()) + 1
    status = "the gradient vanishes" if converged else "the search ended before the gradient vanished"
    ends = [name for name, end in zip(NAMES, at_low | at_high, strict=True) if end]
    unknown = [name for name, error in errors.items() if math.isnan(error) and name not in ends]
    if ends:
        status += f"; at a bound: {', '.join(ends)}"
    if unknown:
        status += f"; the readings do not determine {', '.join(unknown)}"
    if labels is not None:
        status = "; ".join([status, *notes_on_blocks(blocks)])
    none = data.steps == data.bins
    return DiscreteFit(
        log_likelihood=-value * data.total,
        converged=converged,
        standard_errors=errors,
        trace=tuple(-each * data.total for each in trace),
        hits=int(data.counts[~none].sum()),
        max=int(data.counts[none].sum()),
        missing=data.missing,
        status=status,
        independent_errors=independent,
        blocks=blocks,
    )


def _causes(theta: Floats) -> DiscreteCauses:
    short, rand, odds, sigma = (float(value) for value in theta)
    return DiscreteCauses(math.exp(short), math.exp(rand), 1 / (1 + math.exp(-odds)), math.exp(sigma))


def _bounds(data: Counts) -> list[tuple[float, float]]:
    """Return the bounds of the search; beyond them a table changes by less than a part in a million."""
    reach = data.bins * data.width
    rates = math.log(1e-9 / reach), math.log(30 / data.width)
    return [rates, rates, (-25.0, 25.0), (math.log(1e-6 * data.width), math.log(10 * reach))]


def _starts(data: Counts) -> list[Floats]:
    """Make starts from the shares of readings before, at and behind the expected step, the best first.

    Each start takes readings within another number of steps as correct.
    """
    reach, total = data.bins * data.width, data.total
    known, none = data.rows < data.bins, data.steps == data.bins
    starts = []
    for near in sorted({0, 1, 3, max(data.bins // 30, 1), max(data.bins // 8, 1)}):
        at = known & ~none & (np.abs(data.rows - data.steps) <= near)
        short, behind = (float(data.counts[where & ~at].sum()) / total for where in (data.steps < data.rows, ~none))
        expected = float(data.counts[known].sum())
        detected = float(data.counts[at].sum()) / expected if expected else 0.5
        guess = [
            math.log(max(short, 1e-3) / (0.5 * reach)), math.log(max(behind - short, 1e-3) / reach),
            math.log((detected + 0.01) / (1.01 - detected)), math.log(max(0.5 * near, 0.2) * data.width),
        ]  # fmt: skip
        starts.append(np.clip(guess, *np.transpose(_bounds(data))))
    return sorted(starts, key=lambda theta: _loss(data, theta))


def _standard_errors(
    data: Counts, theta: Floats, free: NDArray[np.bool], labels: Integers | None = None
) -> dict[str, float]:
    """Compute standard errors in the units of the parameters, over blocks if there are any; NaN if undetermined."""
    errors = np.full(len(theta), np.nan)
    information = _information(data, theta, np.flatnonzero(free))
    # Differences by a parameter without influence contain only rounding errors.
    size = np.diagonal(information)
    kept = np.flatnonzero(size > 1e-8 * max(float(size.max(initial=0)), 0))
    places = np.flatnonzero(free)[kept]
    if len(places):
        scatter = None if labels is None else _block_scatter(data, theta, places, labels)
        errors[places] = errors_of(information[np.ix_(kept, kept)], np.eye(len(places)), scatter, _FLAT_SHARE)
    errors[~np.isfinite(errors)] = np.nan
    causes = _causes(theta)
    scale = {name: getattr(causes, name) for name in NAMES} | {"p_detect": causes.p_detect * (1 - causes.p_detect)}
    return {name: float(error * scale[name]) for name, error in zip(NAMES, errors, strict=True)}


def _information(data: Counts, theta: Floats, places: Integers) -> Floats:
    """Return the (m, m) observed information of some parameters of the search."""

    def loss(*shifts: Floats) -> float:
        return _loss(data, theta + np.sum(shifts, axis=0))

    steps = _SECOND * np.eye(len(theta))[places]
    information = np.zeros((len(places), len(places)))
    middle = _loss(data, theta)
    for a, one in enumerate(steps):
        information[a, a] = (loss(one) - 2 * middle + loss(-one)) / _SECOND**2
        for b, two in enumerate(steps[:a]):
            mixed = loss(one, two) - loss(one, -two) - loss(-one, two) + loss(-one, -two)
            information[a, b] = information[b, a] = mixed / (4 * _SECOND**2)
    return information * data.total


@dataclass(frozen=True)
class Counts:
    """Counts of readings: ``counts[k]`` readings in step ``steps[k]`` with an obstacle expected in ``rows[k]``."""

    rows: NDArray[np.int64]  # (K,) steps of expected ranges
    steps: NDArray[np.int64]  # (K,) steps of readings
    counts: Floats  # (K,) numbers of readings
    missing: int  # number of missing readings
    bins: int  # number of steps along the beam
    width: float  # width of a step [m]

    @property
    def total(self) -> float:
        """Number of readings that are not missing."""
        return float(self.counts.sum())

    def log_likelihood(self, causes: DiscreteCauses) -> float:
        """Return the log-likelihood of all readings, from the probabilities of their steps."""
        log_p = separate_causes(self.bins, self.width, **causes.to_dict(), rows=self.rows, steps=self.steps)
        return float(self.counts @ log_p)

    def coarser(self, bins: int) -> Counts:
        """Return approximate counts in fewer steps."""
        scale = bins / self.bins
        both = np.trunc(np.stack([self.rows, self.steps]) * scale).astype(np.int64)
        cells, inverse = np.unique(both, axis=1, return_inverse=True)
        counts = np.bincount(inverse.ravel(), self.counts).astype(np.float64)
        return Counts(cells[0], cells[1], counts, self.missing, bins, self.bins * self.width / bins)


def count_pairs(ranges: object, expected: object, range_max: float, bins: int) -> Counts:
    """Count readings; see ``DiscreteBeamModel.learn`` for arguments and errors."""
    range_max = checks.real("range_max", range_max, low=checks.SMALLEST, high=checks.FARTHEST)
    bins = checks.integer("bins", bins, low=1, high=MOST_BINS)
    z, z_exp = (
        checks.as_array(name, value, masked=True) for name, value in (("ranges", ranges), ("expected", expected))
    )
    if z.shape != z_exp.shape:
        shapes = checks.shape_text(z.shape), checks.shape_text(z_exp.shape)
        raise ValueError(f"expected: shape must be {shapes[0]}, got {shapes[1]}")
    z, z_exp = z.reshape(-1), z_exp.reshape(-1)
    table, missing = np.zeros((bins + 1) ** 2, np.int64), 0
    for first in range(0, max(len(z), 1), _BLOCK):
        block = slice(first, first + _BLOCK)
        readings, expected_ranges = check_pairs(z[block], z_exp[block], range_max)
        i, j = bins_of(readings, range_max, bins), bins_of(expected_ranges, range_max, bins)
        missing += int(np.count_nonzero(i < 0))
        # bincount returns bins up to the last occupied one.
        counts = np.bincount((j * (bins + 1) + i)[i >= 0])
        table[: len(counts)] += counts
    cells = np.flatnonzero(table)
    if cells.size == 0:
        raise ValueError(f"ranges: must have a reading that is not missing, got {missing} missing ones")
    return Counts(cells // (bins + 1), cells % (bins + 1), table[cells].astype(float), missing, bins, range_max / bins)
