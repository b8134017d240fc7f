"""Build the user's result from the end of a search: parameters, standard errors and status."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gpusense.learning.beam.device_sums import DeviceSums
from gpusense.learning.beam.em import Climb, newton_direction
from gpusense.learning.beam.options import Options
from gpusense.learning.beam.pairs import Pairs
from gpusense.learning.beam.point import BIAS, HIT, NAMES, RATE, SHORT, SIGMA, Point
from gpusense.learning.beam.problem import NOTHING, Problem, Value
from gpusense.learning.beam.result import BeamFit
from gpusense.learning.beam.uncertainty import standard_errors
from gpusense.world.scanner import Reading


def report(problem: Problem, climb: Climb, options: Options) -> BeamFit:
    """Build the fit from the end of a search."""
    device, pairs = problem.device, problem.pairs
    value = problem.value(climb.value.point, second=True)
    held = _held(problem, value)
    errors = standard_errors(problem, value)
    bias, bias_error = _bias(problem, value)
    parameter_errors = {name: errors[name] for name in NAMES[:BIAS]}
    notes = list(climb.notes)
    if not climb.converged and not notes:
        notes.append("did not converge")
    count = int((value.point.weights > 0).sum()) - 1 + int(value.point.weights[HIT] > 0)
    if problem.readings < count:
        readings = "1 reading" if problem.readings == 1 else f"{problem.readings} readings"
        notes.append(f"{readings} cannot determine {count} parameters")
    for name, error in parameter_errors.items():
        if error == math.inf:
            held[name] = "the readings do not determine it"
    notes += [f"{name}: {reason}" for name, reason in held.items()]
    head = "converged" if climb.converged else "stopped"
    return BeamFit(
        parameters=value.point.parameters(),
        log_likelihood=value.log_likelihood,
        trace=np.array(climb.trace),
        converged=climb.converged,
        status="; ".join([head, *notes]),
        standard_errors=parameter_errors,
        held=held,
        range_bias=bias,
        range_bias_error=bias_error,
        bias_fitted=options.range_bias,
        iterations=len(climb.trace) - 1,
        passes=device.passes,
        hits=pairs.hits,
        max_readings=pairs.max_readings,
        missing=pairs.missing,
        outliers=round(float(value.sums[14])),
        method=options.method,
        precision=device.real.name,
        device=device.selection,
        responsibilities=_responsibilities(device, pairs, value.point) if options.responsibilities else None,
    )


def _held(problem: Problem, value: Value) -> dict[str, str]:
    """Return the reasons why parameters were not free, by name."""
    point, bounds = value.point, problem.bounds
    held = {}
    for cause in range(4):
        if point.weights[cause] == 0:
            held[NAMES[cause]] = "no reading needs this cause"
        elif point.weights[cause] == 1:
            held[NAMES[cause]] = "every reading has this cause"
    free = problem.free(value)
    shapes = ((SIGMA, HIT, point.sigma, bounds.sigma), (RATE, SHORT, point.rate, bounds.rate))
    for place, cause, shape, (low, high) in shapes:
        if value.totals[cause] <= NOTHING:
            held[NAMES[place]] = f"kept, since {NAMES[cause]} accounts for no reading"
        elif not free[place]:
            side, bound = ("lower", low) if shape <= low else ("upper", high)
            held[NAMES[place]] = f"at its {side} bound {bound:.3g}"
    return held


def _bias(problem: Problem, value: Value) -> tuple[float, float]:
    """Return the offset of correct ranges and its standard error; to first order if it was not fitted."""
    if value.totals[HIT] <= NOTHING:
        return value.point.bias, math.nan
    with_bias = Problem(problem.device, problem.pairs, problem.bounds, problem.prior, True)
    error = standard_errors(with_bias, value)[NAMES[BIAS]]
    if problem.fit_bias:
        return value.point.bias, error
    if math.isfinite(error):
        # One Newton step from 0 in all coordinates.
        return float(newton_direction(with_bias, value)[0][BIAS]), error
    # Too far from the optimum for a Newton step: the mean of correct readings, weighted by their responsibilities.
    correct = float(value.sums[1])
    if correct <= 0:
        return 0.0, error
    return float(value.sums[12]) / correct, value.point.sigma / math.sqrt(correct)


def _responsibilities(device: DeviceSums, pairs: Pairs, point: Point) -> NDArray[np.float64]:
    """Return the (n, 4) responsibilities of all readings, in the caller's order."""
    rows = np.full((len(pairs.kinds), 4), np.nan)
    rows[pairs.kinds == Reading.MAX] = [0, 0, 1, 0]
    _, hit, short, rand = device.causes(point).T
    rows[pairs.places] = np.stack([hit, short, np.zeros_like(hit), rand], axis=1)
    return rows
