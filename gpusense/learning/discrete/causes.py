"""Causes of readings in the discrete model, and the result of learning them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from gpusense._util.html import card
from gpusense.world.parameters import _Parameters


@dataclass(frozen=True)
class DiscreteCauses(_Parameters):
    """Parameters of independent causes of a reading; the first cause to trigger hides all later ones.

    In terms of Fox, Burgard and Thrun (1999), ``c_r = 1 - exp(-(lambda_short + lambda_rand) width)`` is the
    probability that the beam triggers in a step without a mapped obstacle, and ``c_d = p_detect``.

    Raises:
        TypeError: A value is not a real number.
        ValueError: A value breaks its field's rule.

    Example:
        >>> import gpusense as gs
        >>> causes = gs.DiscreteCauses(p_detect=0.8)
        >>> gs.DiscreteBeamModel(causes, range_max=5.0, bins=50).probabilities.shape
        (51, 51)
    """

    lambda_short: float = 0.05
    """Rate of unknown obstacles in front of the expected one, >= 0 [1/m]."""
    lambda_rand: float = 0.01
    """Rate of random triggers along the whole beam, also behind a missed obstacle, >= 0 [1/m]."""
    p_detect: float = 0.95
    """Probability of detecting the expected obstacle if no cause triggers earlier, in [0, 1]."""
    sigma_hit: float = 0.05
    """Standard deviation of the detected range, >= 0 [m]; 0 always detects the obstacle in its step."""

    def __post_init__(self) -> None:
        self._check("lambda_short", low=0)
        self._check("lambda_rand", low=0)
        self._check("p_detect", low=0, high=1)
        self._check("sigma_hit", low=0)


@dataclass(frozen=True)
class DiscreteFit:
    """Result of learning a :class:`DiscreteBeamModel`.

    Example:
        >>> import gpusense as gs
        >>> table = gs.DiscreteBeamModel.learn([1.9, 2.0, 2.1, 5.0], [2.0, 2.0, 2.0, 2.0], range_max=5.0, bins=10)
        >>> table.fit.hits, table.fit.max, table.fit.missing
        (3, 1, 0)
    """

    log_likelihood: float
    """Log-likelihood of all readings: probabilities of bins, not densities; natural logarithm."""
    converged: bool
    """Whether the gradient vanishes at the result, within the bounds of the search."""
    standard_errors: Mapping[str, float]
    """Standard error of each parameter, in its unit, from the curvature of the likelihood; NaN if undetermined."""
    trace: tuple[float, ...]
    """Log-likelihood after each iteration of the best search."""
    hits: int
    """Number of readings with a range."""
    max: int
    """Number of readings without a return."""
    missing: int
    """Number of missing readings."""
    status: str
    """Reason for the end of the search, and undetermined parameters, in words."""
    independent_errors: Mapping[str, float] = field(default_factory=dict)
    """Standard errors for independent readings; equal to ``standard_errors`` without blocks."""
    blocks: int = 0
    """Number of blocks behind ``standard_errors``; 0 without blocks."""

    def __repr__(self) -> str:
        return (
            f"DiscreteFit(log_likelihood={self.log_likelihood:.6g}, hits={self.hits}, max={self.max}, "
            f"missing={self.missing}, converged={self.converged})"
        )

    def _repr_html_(self) -> str:
        rows = list(self.standard_errors.items())
        return card(f"DiscreteFit: {self.status}", rows, head=("parameter", "standard error"), detail=repr(self))
