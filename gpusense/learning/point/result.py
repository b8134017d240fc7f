"""Result of a fit of a position, heading, beacon or bumper model."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from gpusense._util.typing import Floats, Integers
from gpusense.learning.fitted import Fitted
from gpusense.learning.information import errors_of, scatter_of
from gpusense.learning.point.problem import Problem
from gpusense.learning.point.search import Climb
from gpusense.world.parameters import BeamParameters
from gpusense.world.sensor_parameters import BeaconParameters, BumperParameters, HeadingParameters, PositionParameters

P = TypeVar("P", BeaconParameters, BeamParameters, BumperParameters, HeadingParameters, PositionParameters)
# Standard errors over fewer blocks are rough.
_FEW_BLOCKS = 10


@dataclass(frozen=True, eq=False)
class PointFit(Fitted[P]):
    """Parameters of a position, heading, beacon or bumper model, fitted to readings at known poses.

    ``print(fit)`` shows a table of parameters and standard errors.

    Attributes:
        parameters: The parameters.
        log_likelihood: Log-likelihood of the readings that the model evaluates, natural log.
        trace: (iterations + 1,) log-likelihood at the start and after each iteration.
        converged: Whether the search ended at an optimum; ``status`` gives the reason for False.
        status: Summary of the fit in words.
        standard_errors: Standard errors of the fitted parameters by name: over blocks if there are any. NaN for a
            parameter at a bound, infinite if the readings do not determine it; see ``held``.
        independent_errors: Standard errors for independent readings.
        held: Reason why a parameter has no standard error, by name.
        values: Fitted parameters by the names in ``standard_errors``.
        iterations: Iterations of the search.
        readings: Number of used readings.
        missing: Number of missing readings.
        blocks: Number of blocks; 0 without blocks.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> noise = np.random.default_rng(0).normal(0.02, 0.1, 1000)
        >>> fit = gs.fit_heading_parameters(np.zeros((1000, 3)), noise)
        >>> fit.converged, round(fit.parameters.sigma, 2), sorted(fit.standard_errors)
        (True, 0.1, ['offset', 'sigma', 'z_hit', 'z_rand'])
    """

    independent_errors: dict[str, float]
    values: dict[str, float]
    readings: int
    blocks: int

    def __repr__(self) -> str:
        text = ", ".join(f"{name}={value:.4g}" for name, value in self.values.items())
        return f"PointFit({text}, converged={self.converged})"

    def _value(self, name: str) -> float:
        return self.values[name]

    def __str__(self) -> str:
        lines = self._table({}, self.independent_errors if self.blocks else {})
        blocks = f"; errors over {self.blocks} blocks" if self.blocks else ""
        lines.append(
            f"log-likelihood {self.log_likelihood:.6f} of {self.readings} readings, {self.missing} missing{blocks}"
        )
        lines.append(f"{self.iterations} iterations: {self.status}")
        return "\n".join(lines)


def report(problem: Problem, end: Climb, parameters: P, blocks: Integers | None, missing: int) -> PointFit[P]:
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
    rough = [name for name in values if name not in held and touched[name] < _FEW_BLOCKS] if blocks is not None else []
    if blocks is not None and count < _FEW_BLOCKS:
        notes.append(f"standard errors are rough, from {count} blocks")
    elif rough:
        notes.append(f"standard errors from fewer than {_FEW_BLOCKS} blocks are rough: {_list(rough)}")
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
    scatter = None if blocks is None else _scatter(problem.log_p(end.theta)[1][:, free], blocks)
    errors = errors_of(-problem.hessian(end.theta, free), rows, scatter)
    errors[~rows.any(axis=1)] = math.nan
    return dict(zip(problem.values(end.theta), errors.tolist(), strict=True))


def _scatter(gradients: Floats, blocks: Integers) -> Floats:
    size = int(blocks.max()) + 1
    return scatter_of(np.stack([np.bincount(blocks, column, size) for column in gradients.T], axis=1))


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
