"""What a fit found, and how far it may be trusted."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense.world.parameters import BeamParameters

_UNITS = {"sigma_hit": "m", "lambda_short": "1/m", "range_bias": "m"}


@dataclass(frozen=True, eq=False)
class BeamFit:
    """The beam model's parameters as learned from readings.

    Attributes:
        parameters: The parameters, all finite.
        log_likelihood: Of the readings with them, natural log; hits are densities [1/m], max readings probabilities.
        trace: (iterations + 1,) the log-likelihood at the start and after each iteration, that of the prior included
            where there is one.
        converged: Whether the method came to rest; ``status`` says why not. That is at an optimum of the likelihood,
            but with ``"em-book"`` where the book's own equations hold.
        status: What is to be known of the fit, in words.
        standard_errors: Of each parameter by its name, from the observed information. NaN where a parameter was held
            (the weight of a cause that does not occur, a shape at a bound or of such a cause), infinite where the
            readings say nothing of it; ``held`` has the reasons.
        held: Why a parameter has no standard error, by its name.
        range_bias: Offset b of correct ranges, z = z* + b: fitted with ``range_bias=True``, else what it would be to
            first order [m].
        range_bias_error: Its standard error [m].
        bias_fitted: Whether the parameters were fitted together with it.
        iterations: Iterations of the method.
        passes: How often the pairs were summed over.
        hits: Readings that are ranges.
        max_readings: Readings that are "no return".
        missing: Readings that say nothing, left out.
        outliers: Hits whose likeliest cause is z_rand: what the fit leaves unexplained.
        method: The method's name.
        precision: ``"float64"`` or ``"float32"``, that of the sums over pairs.
        device: What selects the device it ran on.
        responsibilities: (n, 4) probabilities of hit, short, max and rand for each reading, where asked for; NaN for
            missing readings.
    """

    parameters: BeamParameters
    log_likelihood: float
    trace: NDArray[np.float64]
    converged: bool
    status: str
    standard_errors: dict[str, float]
    held: dict[str, str]
    range_bias: float
    range_bias_error: float
    bias_fitted: bool
    iterations: int
    passes: int
    hits: int
    max_readings: int
    missing: int
    outliers: int
    method: str
    precision: str
    device: str
    responsibilities: NDArray[np.float64] | None = field(default=None, repr=False)

    def to_dict(self) -> dict[str, Any]:
        """Everything but the responsibilities as plain numbers, lists and strings; no number is NaN or infinite.

        A standard error that is not finite is None.
        """
        names = ["log_likelihood", "converged", "status", "held", "bias_fitted", "iterations", "passes", "hits"]
        names += ["max_readings", "missing", "outliers", "method", "precision", "device"]
        return {
            "parameters": self.parameters.to_dict(),
            "standard_errors": {name: _finite(error) for name, error in self.standard_errors.items()},
            "range_bias": _finite(self.range_bias),
            "range_bias_error": _finite(self.range_bias_error),
            "trace": [_finite(number) for number in self.trace.tolist()],
            **{name: getattr(self, name) for name in names},
        }

    def __str__(self) -> str:
        rows = [(name, value, self.standard_errors[name]) for name, value in self.parameters.to_dict().items()]
        lines = [f"{'parameter':14}{'value':>13}{'std. error':>13}"]
        for name, value, error in rows:
            shown = f"{error:13.3g}" if math.isfinite(error) else f"{'inf' if error == math.inf else '-':>13}"
            note = f"  {self.held[name]}" if name in self.held else ""
            lines.append(f"{name:14}{value:13.6g}{shown} {_UNITS.get(name, ''):4}{note}".rstrip())
        kind = "fitted" if self.bias_fitted else "estimated, not in the parameters"
        lines.append(f"{'range_bias':14}{self.range_bias:13.6g}{self.range_bias_error:13.3g} m    {kind}")
        lines.append(
            f"log-likelihood {self.log_likelihood:.6f} of {self.hits} hits and {self.max_readings} max readings; "
            f"{self.missing} missing, {self.outliers} unexplained"
        )
        lines.append(f"{self.method}, {self.iterations} iterations, {self.precision} on {self.device}: {self.status}")
        return "\n".join(lines)


def _finite(number: float) -> float | None:
    return number if math.isfinite(number) else None
