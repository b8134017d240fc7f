"""What a fit of the landmark model found, and how far it may be trusted."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense.world.parameters import LandmarkParameters

_UNITS = {"sigma_range": "m", "sigma_bearing": "rad", "range_bias": "m", "bearing_bias": "rad"}


@dataclass(frozen=True, eq=False)
class LandmarkFit:
    """The landmark model's parameters as learned from features at known poses.

    Attributes:
        parameters: The parameters. A deviation is None where no feature has that part; p_detect is the start's where
            it could not be counted.
        log_likelihood: Of the features with them, natural log; densities in 1/m, 1/rad and 1/unit of the signature.
        trace: (iterations + 1,) the log-likelihood at the start and after each iteration.
        converged: Whether the search came to rest at an optimum; ``status`` says why not.
        status: What is to be known of the fit, in words.
        standard_errors: Of sigma_range, sigma_bearing, sigma_signature, z_detect, z_false and p_detect, from the
            observed information (p_detect: of a share). NaN where there is none; ``held`` has the reasons.
        held: Why a parameter has no standard error, by its name.
        range_bias: Offset of ranges, r = d + offset: fitted with ``bias=True``, else the mean residual of the
            features that are landmarks; NaN without ranges [m].
        range_bias_error: Its standard error [m].
        bearing_bias: Offset of bearings, as for ranges [rad].
        bearing_bias_error: Its standard error [rad].
        bias_fitted: Whether the parameters were fitted together with the offsets.
        iterations: Iterations of the search.
        features: Features that say something.
        missing: Features of which nothing was measured, left out.
        false_positives: Expected number of features that are no landmark.
        expected: Landmarks in view, over all poses; 0 where features were not given by scans.
        detected: Expected number of these that a feature is.
        false: (F,) probability of each feature to be a false positive; NaN for missing ones.
    """

    parameters: LandmarkParameters
    log_likelihood: float
    trace: NDArray[np.float64]
    converged: bool
    status: str
    standard_errors: dict[str, float]
    held: dict[str, str]
    range_bias: float
    range_bias_error: float
    bearing_bias: float
    bearing_bias_error: float
    bias_fitted: bool
    iterations: int
    features: int
    missing: int
    false_positives: float
    expected: int
    detected: float
    false: NDArray[np.float64] = field(repr=False)

    def to_dict(self) -> dict[str, Any]:
        """Everything but ``false`` as plain numbers, lists and strings; what is not finite is None."""
        biases = ["range_bias", "range_bias_error", "bearing_bias", "bearing_bias_error"]
        names = ["log_likelihood", "converged", "status", "held", "bias_fitted", "iterations", "features", "missing"]
        names += ["false_positives", "expected", "detected"]
        return {
            "parameters": self.parameters.to_dict(),
            "standard_errors": {name: _finite(error) for name, error in self.standard_errors.items()},
            **{name: _finite(getattr(self, name)) for name in biases},
            "trace": [_finite(number) for number in self.trace.tolist()],
            **{name: getattr(self, name) for name in names},
        }

    def __str__(self) -> str:
        rows = [
            (name, getattr(self.parameters, name), error, self.held.get(name, ""))
            for name, error in self.standard_errors.items()
        ]
        kind = "fitted" if self.bias_fitted else "estimated, not in the parameters"
        rows += [(name, getattr(self, name), getattr(self, f"{name}_error"), kind) for name in
                 ("range_bias", "bearing_bias") if math.isfinite(getattr(self, name))]  # fmt: skip
        lines = [f"{'parameter':16}{'value':>13}{'std. error':>13}"]
        for name, value, error, note in rows:
            if value is not None:
                shown = f"{error:13.3g}" if math.isfinite(error) else f"{'-':>13}"
                lines.append(f"{name:16}{value:13.6g}{shown} {_UNITS.get(name, ''):4} {note}".rstrip())
        lines.append(
            f"log-likelihood {self.log_likelihood:.6f} of {self.features} features; {self.missing} missing, "
            f"{self.false_positives:.1f} false positives"
        )
        if self.expected:
            lines.append(f"{self.detected:.1f} of {self.expected} landmarks in view were seen")
        lines.append(f"{self.iterations} iterations: {self.status}")
        return "\n".join(lines)


def _finite(number: float) -> float | None:
    return number if math.isfinite(number) else None
