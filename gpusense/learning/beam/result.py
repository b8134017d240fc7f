"""Result of a fit of the beam model."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gpusense.learning.fitted import FitRow, Fitted
from gpusense.world.parameters import BeamParameters

_UNITS = {"sigma_hit": "m", "lambda_short": "1/m", "range_bias": "m"}


@dataclass(frozen=True, eq=False)
class BeamFit(Fitted[BeamParameters]):
    """Parameters of the beam model, fitted to readings by :func:`fit_beam_parameters`.

    ``print(fit)`` shows a table of parameters and standard errors.

    Attributes:
        parameters: The parameters, all finite.
        log_likelihood: Log-likelihood of the readings, natural log; hits count with densities [1/m], max readings with
            probabilities.
        trace: (iterations + 1,) log-likelihood, plus the log prior if there is one, at the start and after each
            iteration.
        converged: Whether the method converged, at an optimum of the likelihood; with ``"em-book"``, at a solution of
            the book's equations. ``status`` gives the reason for False.
        status: Summary of the fit in words.
        standard_errors: Standard error of each parameter by name: with ``blocks=``, from the scatter over blocks; else
            from the observed information, for independent readings. NaN for a held parameter (the weight of a cause
            that does not occur, its shape, or a shape at a bound), infinite if the readings do not determine it; see
            ``held``.
        independent_errors: Standard errors for independent readings, by name; equal to ``standard_errors`` without
            blocks.
        blocks: Number of blocks behind ``standard_errors``; 0 without blocks.
        held: Reason why a parameter has no standard error, by name.
        range_bias: Offset b of correct ranges, z = z* + b [m]: its maximum-likelihood estimate jointly with the other
            parameters. Unless ``range_bias=True``, a second search estimates it, and ``parameters`` do not contain it.
            NaN if a search did not converge, and for ``"em-book"``.
        range_bias_error: Standard error of ``range_bias`` [m], as in ``standard_errors``.
        bias_fitted: Whether the parameters were fitted together with the offset.
        iterations: Iterations of the method.
        passes: Passes over the pairs.
        hits: Number of readings that are ranges.
        max_readings: Number of readings that are "no return".
        missing: Number of missing readings.
        outliers: Number of hits whose likeliest cause is z_rand: unexplained readings.
        method: Name of the method.
        precision: ``"float64"`` or ``"float32"``, of the sums over pairs.
        device: Text that selects the device of the fit.
        responsibilities: (n, 4) probabilities of hit, short, max and rand for each reading, or None; NaN for missing
            readings.

    Example:
        >>> import gpusense as gs
        >>> fit = gs.fit_beam_parameters([3.9, 4.1, 4.0, 8.0], [4.0] * 4, range_max=8.0, backend="numpy")
        >>> fit.converged, fit.hits, fit.max_readings, round(fit.parameters.z_max, 3)
        (True, 3, 1, 0.25)
    """

    range_bias: float
    range_bias_error: float
    bias_fitted: bool
    passes: int
    hits: int
    max_readings: int
    outliers: int
    method: str
    precision: str
    device: str
    independent_errors: dict[str, float]
    blocks: int
    responsibilities: NDArray[np.float64] | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        values = ", ".join(
            f"{name}={value!r}" if isinstance(value, str) else f"{name}={value:.4g}"
            for name, value in self.parameters.to_dict().items()
        )
        return f"BeamFit({values}, converged={self.converged})"

    def _rows(self) -> list[FitRow]:
        kind = "fitted" if self.bias_fitted else "estimated, not in the parameters"
        return [*super()._rows(), FitRow("range_bias", self.range_bias, self.range_bias_error, kind)]

    def __str__(self) -> str:
        lines = self._table(_UNITS, self.independent_errors if self.blocks else {})
        if self.blocks:
            lines.append(f"standard errors over {self.blocks} blocks of readings")
        lines.append(
            f"log-likelihood {self.log_likelihood:.6f} of {self.hits} hits and {self.max_readings} max readings; "
            f"{self.missing} missing, {self.outliers} unexplained"
        )
        lines.append(f"{self.method}, {self.iterations} iterations, {self.precision} on {self.device}: {self.status}")
        return "\n".join(lines)
