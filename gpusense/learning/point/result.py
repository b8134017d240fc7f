"""Result of a fit of a position, heading, beacon or bumper model."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from gpusense._util.html import FIT_HEAD, card
from gpusense.world.parameters import BeamParameters
from gpusense.world.sensor_parameters import BeaconParameters, BumperParameters, HeadingParameters, PositionParameters

P = TypeVar("P", BeaconParameters, BeamParameters, BumperParameters, HeadingParameters, PositionParameters)


@dataclass(frozen=True, eq=False)
class PointFit(Generic[P]):
    """Parameters of a position, heading, beacon or bumper model, fitted to readings at known poses.

    ``print(fit)`` shows a table of parameters and standard errors.

    Attributes:
        parameters: The parameters.
        log_likelihood: Log-likelihood of the readings that the model evaluates, natural log.
        trace: (iterations + 1,) log-likelihood at the start and after each iteration.
        converged: Whether the search ended at an optimum; ``status`` gives the reason for False.
        status: Summary of the fit in words.
        standard_errors: Standard errors of the fitted parameters by name: over blocks if there are any. NaN for a
            parameter at a bound, infinite for one that the readings do not determine; ``held`` has the reasons.
        independent_errors: Standard errors as if the readings were independent.
        held: Reason why a parameter has no standard error, by name.
        values: The fitted parameters by name, as they are named in ``standard_errors``.
        iterations: Iterations of the search.
        readings: Number of readings that were used.
        missing: Number of readings left out.
        blocks: Number of blocks; 0 without blocks.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> noise = np.random.default_rng(0).normal(0.02, 0.1, 1000)
        >>> fit = gs.fit_heading_parameters(np.zeros((1000, 3)), noise)
        >>> fit.converged, round(fit.parameters.sigma, 2), sorted(fit.standard_errors)
        (True, 0.1, ['offset', 'sigma', 'z_hit', 'z_rand'])
    """

    parameters: P
    log_likelihood: float
    trace: NDArray[np.float64]
    converged: bool
    status: str
    standard_errors: dict[str, float]
    independent_errors: dict[str, float]
    held: dict[str, str]
    values: dict[str, float]
    iterations: int
    readings: int
    missing: int
    blocks: int

    def to_dict(self) -> dict[str, Any]:
        """Return all attributes as plain numbers, lists and strings; None if not finite."""
        names: tuple[str, ...] = (
            "log_likelihood",
            "converged",
            "status",
            "held",
            "values",
            "iterations",
            "readings",
            "missing",
        )
        errors = {name: _finite_values(getattr(self, name)) for name in ("standard_errors", "independent_errors")}
        return {
            "parameters": self.parameters.to_dict(),
            **{name: getattr(self, name) for name in (*names, "blocks")},
            **errors,
            "trace": self.trace.tolist(),
        }

    def __repr__(self) -> str:
        text = ", ".join(f"{name}={value:.4g}" for name, value in self.values.items())
        return f"PointFit({text}, converged={self.converged})"

    def _repr_html_(self) -> str:
        rows = [
            (name, value, self.standard_errors[name], self.held.get(name, "")) for name, value in self.values.items()
        ]
        return card(f"PointFit: {self.status}", rows, head=FIT_HEAD, detail=str(self))

    def __str__(self) -> str:
        title = f"{'parameter':16}{'value':>13}{'std. error':>13}"
        lines = [title + (f"{'if independent':>16}" if self.blocks else "")]
        for name, value in self.values.items():
            columns = [(self.standard_errors[name], 13)]
            columns += [(self.independent_errors[name], 16)] if self.blocks else []
            shown = "".join(f"{error:{w}.3g}" if math.isfinite(error) else f"{'-':>{w}}" for error, w in columns)
            lines.append(f"{name:16}{value:13.6g}{shown} {self.held.get(name, '')}".rstrip())
        blocks = f"; errors over {self.blocks} blocks" if self.blocks else ""
        lines.append(
            f"log-likelihood {self.log_likelihood:.6f} of {self.readings} readings, {self.missing} missing{blocks}"
        )
        lines.append(f"{self.iterations} iterations: {self.status}")
        return "\n".join(lines)


def _finite_values(numbers: dict[str, float]) -> dict[str, float | None]:
    return {name: number if math.isfinite(number) else None for name, number in numbers.items()}
