"""Result of a fit of the landmark model."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gpusense.learning.fitted import FitRow, Fitted
from gpusense.world.parameters import LandmarkParameters

_UNITS = {"sigma_range": "m", "sigma_bearing": "rad", "range_bias": "m", "bearing_bias": "rad"}


@dataclass(frozen=True, eq=False)
class LandmarkFit(Fitted[LandmarkParameters]):
    """Parameters of the landmark model, fitted by :func:`fit_landmark_parameters`.

    ``print(fit)`` shows a table of parameters and standard errors.

    Attributes:
        parameters: The parameters. A standard deviation is None if no feature has this part; p_detect keeps its
            initial value unless it was counted.
        log_likelihood: Log-likelihood of the features, natural log; densities in 1/m, 1/rad and 1/unit of the
            signature.
        trace: (iterations + 1,) log-likelihood at the start and after each iteration.
        converged: Whether the search ended at an optimum; ``status`` gives the reason for False.
        status: Summary of the fit in words.
        standard_errors: Standard errors of sigma_range, sigma_bearing, sigma_signature, z_detect, z_false and p_detect,
            from the observed information (p_detect: of a share). NaN for a held parameter; see ``held``.
        held: Reason why a parameter has no standard error, by name.
        range_bias: Offset of ranges, r = d + offset: fitted with ``bias=True``, else the mean residual of features
            from landmarks; NaN without ranges [m].
        range_bias_error: Standard error of ``range_bias`` [m].
        bearing_bias: Offset of bearings, as for ranges [rad].
        bearing_bias_error: Standard error of ``bearing_bias`` [rad].
        bias_fitted: Whether the parameters were fitted together with the offsets.
        iterations: Iterations of the search.
        features: Number of features with at least one measured part.
        missing: Number of features without any measured part.
        false_positives: Expected number of false positives.
        expected: Number of landmarks in view, over all poses; 0 without ``scan``.
        detected: Expected number of detected landmarks among these.
        false: (F,) probability that each feature is a false positive; NaN for missing features.

    Example:
        >>> import gpusense as gs
        >>> landmarks = gs.LandmarkMap([(5, 0), (0, 5)])
        >>> features = [(5.1, 0.0), (4.9, 0.0), (5.0, 1.6), (5.1, 1.5)]
        >>> fit = gs.fit_landmark_parameters([(0, 0, 0)] * 4, features, landmarks, correspondence=[0, 0, 1, 1])
        >>> fit.converged, fit.features, round(fit.parameters.sigma_range, 3)
        (True, 4, 0.087)
    """

    range_bias: float
    range_bias_error: float
    bearing_bias: float
    bearing_bias_error: float
    bias_fitted: bool
    features: int
    false_positives: float
    expected: int
    detected: float
    false: NDArray[np.float64] = field(repr=False)

    def __repr__(self) -> str:
        names = ("sigma_range", "sigma_bearing", "sigma_signature", "z_detect", "z_false", "p_detect")
        values = [(name, getattr(self.parameters, name)) for name in names]
        text = ", ".join(f"{name}={value:.4g}" for name, value in values if value is not None)
        return f"LandmarkFit({text}, converged={self.converged})"

    def _rows(self) -> list[FitRow]:
        kind = "fitted" if self.bias_fitted else "estimated, not in the parameters"
        biases = [
            ("range_bias", self.range_bias, self.range_bias_error),
            ("bearing_bias", self.bearing_bias, self.bearing_bias_error),
        ]
        return [*super()._rows(), *(FitRow(*bias, kind) for bias in biases if math.isfinite(bias[1]))]

    def __str__(self) -> str:
        lines = self._table(_UNITS, {})
        lines.append(
            f"log-likelihood {self.log_likelihood:.6f} of {self.features} features; {self.missing} missing, "
            f"{self.false_positives:.1f} false positives"
        )
        if self.expected:
            lines.append(f"{self.detected:.1f} of {self.expected} landmarks in view were seen")
        lines.append(f"{self.iterations} iterations: {self.status}")
        return "\n".join(lines)
