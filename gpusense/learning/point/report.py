"""Report the end of a search over a position, heading, beacon or bumper model."""

from __future__ import annotations

import math

import numpy as np

from gpusense._util.typing import Integers
from gpusense.learning.fitted import PointFit, Q
from gpusense.learning.information import FEW_BLOCKS, errors_of, notes_on_blocks, scatter_of
from gpusense.learning.point.problem import Climb, Problem


def report(problem: Problem, end: Climb, parameters: Q, blocks: Integers | None, missing: int) -> PointFit[Q]:
    """Build the fit from the end of a search."""
    values = problem.values(end.theta)
    count = 0 if blocks is None else int(blocks.max()) + 1
    independent = _errors(problem, end, None)
    errors = dict(independent) if blocks is None else _errors(problem, end, blocks)
    touched = _blocks_of(problem, end, blocks)
    held = {}
    for name, error in independent.items():
        if error == math.inf:
            held[name] = "the readings do not determine it"
        elif math.isnan(error):
            held[name] = "at a bound"
        elif blocks is not None and touched[name] < 2:
            held[name], errors[name] = "the readings that determine it are in one block", math.nan
    notes: list[str] = [] if end.converged else ["did not converge"]
    rough = [name for name in values if name not in held and touched[name] < FEW_BLOCKS] if blocks is not None else []
    few = [] if blocks is None else notes_on_blocks(count)
    notes += few
    if rough and not few:
        notes.append(f"standard errors from fewer than {FEW_BLOCKS} blocks are rough: {_list(rough)}")
    for reason in dict.fromkeys(held.values()):
        notes.append(f"{_list([name for name in held if held[name] == reason])}: {reason}")
    return PointFit(
        parameters=parameters,
        log_likelihood=end.value,
        trace=np.array(end.trace),
        converged=end.converged,
        status="; ".join(["converged" if end.converged else "stopped", *notes]),
        standard_errors=errors,
        independent_errors=independent,
        held=held,
        values=values,
        iterations=len(end.trace) - 1,
        readings=problem.readings,
        missing=missing,
        blocks=count,
    )


def _list(names: list[str]) -> str:
    """Return the first names, and the number of further ones."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def _errors(problem: Problem, end: Climb, blocks: Integers | None) -> dict[str, float]:
    """Return the standard errors by name; NaN for parameters that depend only on coordinates at bounds."""
    free = end.free
    rows = problem.jacobian(end.theta)[:, free]
    scatter = None
    if blocks is not None:
        size, gradients = int(blocks.max()) + 1, problem.log_p(end.theta)[1][:, free]
        scatter = scatter_of(np.stack([np.bincount(blocks, column, size) for column in gradients.T], axis=1))
    errors = errors_of(-problem.hessian(end.theta, free), rows, scatter)
    errors[~rows.any(axis=1)] = math.nan
    return dict(zip(problem.values(end.theta), errors.tolist(), strict=True))


def _blocks_of(problem: Problem, end: Climb, blocks: Integers | None) -> dict[str, int]:
    """Return the least number of blocks that depend on a coordinate, for each parameter that it determines."""
    names = list(problem.values(end.theta))
    if blocks is None:
        return dict.fromkeys(names, 0)
    gradients, jacobian = problem.log_p(end.theta)[1], problem.jacobian(end.theta)
    counts = np.array([len(np.unique(blocks[column != 0])) for column in gradients.T])
    used = (jacobian != 0) & end.free
    least = np.where(used, counts, np.iinfo(np.int64).max).min(axis=1)
    return dict(zip(names, least.tolist(), strict=True))
