"""Result of a fit of a position, heading, beacon or bumper model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

from gpusense.learning.fitted import Fitted
from gpusense.world.parameters import BeamParameters
from gpusense.world.sensor_parameters import BeaconParameters, BumperParameters, HeadingParameters, PositionParameters

P = TypeVar("P", BeaconParameters, BeamParameters, BumperParameters, HeadingParameters, PositionParameters)


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
