"""Build the user's result from the end of a search: parameters, standard errors and status.

Standard errors over B blocks with gradients G_b follow from ``H^-1 (sum_b G_b G_b') H^-1`` with the observed
information H. The sum is centred and multiplied by B / (B - 1). Sources and reasons: docs/learning.md.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np
from numpy.typing import NDArray

from gpusense._util.typing import Floats
from gpusense.learning.beam.device_sums import DeviceSums, Options
from gpusense.learning.beam.em import Climb, Watch, climb_em
from gpusense.learning.beam.optimum import Search
from gpusense.learning.beam.pairs import BIAS, FORM, HIT, MAX, NAMES, RAND, RATE, SHORT, SIGMA, Pairs, Point
from gpusense.learning.beam.problem import NOTHING, Problem, Value
from gpusense.learning.fitted import BeamFit, common_fields, errors_of, notes_on_blocks, scatter_of
from gpusense.learning.point.densities import by_shape, truncated
from gpusense.world.range_causes import ShortDensity
from gpusense.world.scanner import Reading

# Largest number of iterations of the search for an unfitted offset.
_JOINT = 500
# Relative step of numerical derivatives by a coordinate of the shape of hits.
_STEP = 1e-5


def report(problem: Problem, climb: Climb, options: Options, start: Point) -> BeamFit:
    """Build the fit from the end of a search that began with the causes of ``start``."""
    device, pairs = problem.device, problem.pairs
    value = problem.value(climb.value.point, second=True)
    errors, independent = _errors(problem, value)
    bias, error, independent[NAMES[BIAS]] = _bias(problem, value, climb, options, start)
    errors = {name: errors[name] for name in value.point.names if name != NAMES[BIAS]}
    return BeamFit(
        parameters=value.point.parameters(),
        **common_fields(
            value.log_likelihood, climb.trace, climb.converged, errors, _held(problem, value),
            _notes(problem, climb, value), pairs.missing,
        ),
        range_bias=bias,
        range_bias_error=error,
        bias_fitted=options.range_bias,
        passes=device.passes,
        hits=pairs.hits,
        max_readings=pairs.max_readings,
        outliers=round(float(value.sums[13])),
        method=options.method,
        precision=device.real.name,
        device=device.selection,
        independent_errors=independent,
        blocks=pairs.blocks,
        responsibilities=_responsibilities(device, pairs, value.point) if options.responsibilities else None,
    )  # fmt: skip


def _notes(problem: Problem, climb: Climb, value: Value) -> list[str]:
    """Return the notes of a search, and warnings of few readings and blocks."""
    notes = climb.notes or ([] if climb.converged else ["did not converge"])
    weights = value.point.weights
    count = int((weights > 0).sum()) - 1 + int(weights[HIT] > 0) * (1 + len(value.point.shape.limits))
    if problem.readings < count:
        readings = "1 reading" if problem.readings == 1 else f"{problem.readings} readings"
        notes = [*notes, f"{readings} cannot determine {count} parameters"]
    return notes if problem.pairs.block is None else notes + notes_on_blocks(problem.pairs.blocks)


def _errors(problem: Problem, value: Value) -> tuple[dict[str, float], dict[str, float]]:
    """Return standard errors by name: over blocks, if any, and for independent readings."""
    independent = _standard_errors(problem, value)
    if problem.pairs.block is None:
        return dict(independent), independent
    sums, counts = block_gradients(problem, value.point)
    return _standard_errors(problem, value, scatter_of(sums[counts > 0])), independent


def _standard_errors(problem: Problem, value: Value, scatter: Floats | None = None) -> dict[str, float]:
    """Compute standard errors by name, over blocks with their scatter: NaN if held, infinite without information."""
    assert value.hessian is not None
    free = problem.free(value)
    places = np.flatnonzero(free)
    jacobian = _jacobian(value.point)
    moved = np.append(value.point.weights > 0, free[4:])
    if not (free[:4]).any():
        # A single weight is 1 and has no error.
        moved[:4] = False
    errors = np.full(len(free), math.nan)
    inner = None if scatter is None else scatter[np.ix_(places, places)]
    errors[moved] = errors_of(-value.hessian[np.ix_(places, places)], jacobian[np.ix_(moved, places)], inner)
    return dict(zip(value.point.names, errors.tolist(), strict=True))


def _jacobian(point: Point) -> Floats:
    shape = point.shape
    count = FORM + len(shape.limits)
    jacobian = np.zeros((count, count))
    jacobian[:4, :4] = np.diag(point.weights) - np.outer(point.weights, point.weights)
    jacobian[SIGMA, SIGMA], jacobian[RATE, RATE], jacobian[BIAS, BIAS] = point.sigma, point.rate, 1.0
    for place, (low, high) in enumerate(shape.limits):
        step = _STEP * shape.coordinates * (np.arange(len(shape.limits)) == place)
        ends = [np.clip(shape.coordinates + sign * step, low, high) for sign in (-1, 1)]
        before, after = (np.array(list(shape.at(end).values().values())) for end in ends)
        jacobian[FORM:, FORM + place] = (after - before) / (ends[1] - ends[0])[place]
    return jacobian


def _held(problem: Problem, value: Value) -> dict[str, str]:
    """Return the reasons why parameters were not free, by name."""
    point, held = value.point, {}
    for cause in range(4):
        if point.weights[cause] in (0, 1):
            reason = "no reading needs this cause" if point.weights[cause] == 0 else "every reading has this cause"
            held[NAMES[cause]] = reason
    free = problem.free(value)
    for place, (cause, at, low, high) in enumerate(problem.shapes(point), SIGMA):
        name, side = point.names[place], "lower bound" if at - low < high - at else "upper bound"
        if place == BIAS:
            continue
        if value.totals[cause] <= NOTHING:
            held[name] = f"kept, since {NAMES[cause]} accounts for no reading"
        elif not free[place]:
            at = point.shape.values()[name] if place >= FORM else at
            held[name] = f"at its {'bound' if place >= FORM else side} {at:.3g}"
    return held


def _bias(problem: Problem, value: Value, climb: Climb, options: Options, start: Point) -> tuple[float, float, float]:
    """Return the offset of correct ranges, by another search unless fitted, with its errors over blocks and without."""
    if problem.fit_bias:
        errors, independent = _errors(problem, value)
        return value.point.bias, errors[NAMES[BIAS]], independent[NAMES[BIAS]]
    if not climb.converged or options.method == "em-book":
        return math.nan, math.nan, math.nan
    if value.totals[HIT] <= NOTHING:
        return value.point.bias, math.nan, math.nan
    joint = Problem(problem.device, problem.pairs, problem.bounds, problem.prior, True)
    if value.point.shape.limits:
        best = _climb_joint(options, joint, value.point, lambda iteration, value: None)
    else:
        search = Search(joint, partial(_climb_joint, options), lambda iteration, value: None)
        best = search.run(start, [], known=value.point)
    if not best.converged:
        return math.nan, math.nan, math.nan
    errors, independent = _errors(joint, joint.value(best.value.point, second=True))
    return best.value.point.bias, errors[NAMES[BIAS]], independent[NAMES[BIAS]]


def _climb_joint(options: Options, problem: Problem, start: Point, watch: Watch) -> Climb:
    return climb_em(problem, start, max_iterations=_JOINT, tolerance=options.tolerance, watch=watch)


def _responsibilities(device: DeviceSums, pairs: Pairs, point: Point) -> NDArray[np.float64]:
    """Return the (n, 4) responsibilities of all readings, in the caller's order."""
    rows = np.full((len(pairs.kinds), 4), np.nan)
    rows[pairs.kinds == Reading.MAX] = [0, 0, 1, 0]
    _, hit, short, rand = device.causes(point).T
    rows[pairs.places] = np.stack([hit, short, np.zeros_like(hit), rand], axis=1)
    return rows


# Number of readings per pass.
_PART = 1 << 18


def block_gradients(problem: Problem, point: Point) -> tuple[Floats, NDArray[np.intp]]:
    """Return the gradients of the blocks' log-likelihoods, one per row, and the (B,) numbers of readings."""
    pairs = problem.pairs
    assert pairs.block is not None
    size = int(pairs.block.max(initial=-1)) + 1
    of_hits, of_max = pairs.block[pairs.places], pairs.block[pairs.kinds == Reading.MAX]
    counts = np.bincount(of_hits, minlength=size) + np.bincount(of_max, minlength=size)
    sums = np.zeros((size, FORM + len(point.shape.limits)))
    sums[:, MAX] = np.bincount(of_max, minlength=size)
    sums[:, : RAND + 1] -= counts[:, None] * point.weights
    causes = problem.device.causes(point)
    for first in range(0, pairs.hits, _PART):
        part = slice(first, first + _PART)
        z, expected = (values[part].astype(np.float64) for values in (pairs.reading, pairs.expected))
        terms = _terms(z, expected, causes[part, 1:], point, pairs.range_max)
        for place, term in terms.items():
            sums[:, place] += np.bincount(of_hits[part], term, size)
    return sums, counts


def _terms(z: Floats, expected: Floats, parts: Floats, point: Point, range_max: float) -> dict[int, Floats]:
    """Return each hit's gradient of log p by coordinate, for (m, 3) responsibilities of hit, short and rand."""
    hit, short, rand = parts.T
    shape, mean = point.shape, np.clip(expected + point.bias, 0, range_max)
    _, by_sigma, by_mean = truncated(z - mean, mean, range_max, point.sigma, shape)
    by_bias = np.where(mean == expected + point.bias, by_mean, 0)
    ends = (z - mean) / point.sigma, mean / point.sigma, (range_max - mean) / point.sigma
    by_form = by_shape(*ends, shape.coordinates, shape.at, shape.limits)
    by_rate = ShortDensity(point.rate).by_log_rate(z, expected)
    return {
        HIT: hit, SHORT: short, RAND: rand,
        SIGMA: np.where(hit > 0, hit * by_sigma, 0.0), BIAS: np.where(hit > 0, hit * by_bias, 0.0),
        RATE: np.where(short > 0, short * by_rate, 0.0),
    } | {FORM + place: np.where(hit > 0, hit * each, 0.0) for place, each in enumerate(by_form)}  # fmt: skip
