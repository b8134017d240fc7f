"""Results of fits, with their tables and conversion to dictionaries, and standard errors from the information."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Generic, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks
from gpusense._util.html import FIT_HEAD, card
from gpusense._util.typing import Floats, Integers
from gpusense.world.parameters import BeamParameters, LandmarkParameters

P = TypeVar("P")
_UNITS = {
    "sigma_hit": "m", "lambda_short": "1/m", "lambda_rand": "1/m", "range_bias": "m", "sigma_range": "m",
    "sigma_bearing": "rad", "bearing_bias": "rad",
}  # fmt: skip


# A row of the table of a fit: name, value, standard error, and a note.
Row: TypeAlias = tuple[str, Any, float, str]


@dataclass(frozen=True, eq=False)
class Fitted(ABC, Generic[P]):
    """Result of a fit; ``print(fit)`` shows a table of parameters and standard errors."""

    parameters: P
    """The parameters."""
    log_likelihood: float
    """Log-likelihood of the readings, natural log."""
    trace: Floats
    """(iterations + 1,) log-likelihood at the start and after each iteration."""
    converged: bool
    """Whether the search ended at an optimum; ``status`` gives the reason for False."""
    status: str
    """Summary of the fit in words."""
    standard_errors: dict[str, float]
    """Standard errors by name, over blocks if there are any: NaN for a held parameter, infinite if undetermined."""
    held: dict[str, str]
    """Reason why a parameter has no standard error, by name."""
    iterations: int
    """Iterations of the search."""
    missing: int
    """Number of missing readings."""

    def to_dict(self) -> dict[str, Any]:
        """Return all attributes except arrays of readings as plain numbers, lists and strings; None if not finite."""
        return plain_fields(self)

    def _rows(self) -> list[Row]:
        return [
            (name, value, error, self.held.get(name, ""))
            for name, error in self.standard_errors.items()
            if (value := self._value(name)) is not None
        ]

    def _value(self, name: str) -> Any:
        """Return a parameter; None without readings of it."""
        return getattr(self.parameters, name)

    def __repr__(self) -> str:
        values = [(name, self._value(name)) for name in self.standard_errors]
        return self._short({name: value for name, value in values if value is not None})

    def _short(self, values: dict[str, Any]) -> str:
        text = ", ".join(f"{name}={v!r}" if isinstance(v, str) else f"{name}={v:.4g}" for name, v in values.items())
        return f"{type(self).__name__}({text}, converged={self.converged})"

    def _repr_html_(self) -> str:
        rows = [(name, value, _error_text(error), note) for name, value, error, note in self._rows()]
        return card(f"{type(self).__name__}: {self.status}", rows, head=FIT_HEAD, detail=str(self))

    def __str__(self) -> str:
        blocks = getattr(self, "blocks", 0)
        independent = getattr(self, "independent_errors", {}) if blocks else {}
        lines = [
            f"{'parameter':16}{'value':>13}{'std. error':>13}{'if independent' if independent else '':>16}".rstrip()
        ]
        for name, value, error, note in self._rows():
            number = f"{value:13.6g}" if math.isfinite(value) else f"{'-':>13}"
            second = f"{_error_text(independent[name]):>16}" if independent else ""
            lines.append(f"{name:16}{number}{_error_text(error):>13}{second} {_UNITS.get(name, ''):4}  {note}".rstrip())
        if blocks:
            lines.append(f"standard errors over {blocks} blocks of readings")
        lines.append(f"log-likelihood {self.log_likelihood:.6f} of {self._counted()}")
        return "\n".join([*lines, f"{self._search()}: {self.status}"])

    @abstractmethod
    def _counted(self) -> str:
        """Return the numbers of readings in words."""

    def _search(self) -> str:
        """Return the search in words."""
        return f"{self.iterations} iterations"


@dataclass(frozen=True, eq=False)
class BeamFit(Fitted[BeamParameters]):
    """Parameters of the beam model, fitted to readings by :func:`fit_beam_parameters`.

    With a prior, ``trace`` includes its log density. Hits count with densities [1/m], max readings with probabilities.
    ``"em-book"`` converges at a solution of the book's equations, other methods at an optimum of the likelihood.
    Standard errors for independent readings come from the observed information.

    Attributes:
        range_bias: Offset b of correct ranges, z = z* + b [m]: its maximum-likelihood estimate jointly with the other
            parameters. Unless ``range_bias=True``, a second search estimates it, and ``parameters`` do not contain it.
            NaN if a search did not converge, and for ``"em-book"``.
        range_bias_error: Standard error of ``range_bias`` [m], as in ``standard_errors``.
        bias_fitted: Whether the parameters were fitted together with the offset.
        passes: Passes over the pairs.
        hits: Number of readings that are ranges.
        max_readings: Number of readings that are "no return".
        outliers: Number of hits whose likeliest cause is z_rand: unexplained readings.
        method: Name of the method.
        precision: ``"float64"`` or ``"float32"``, of the sums over pairs.
        device: Text that selects the device of the fit.
        independent_errors: Standard errors for independent readings, by name; equal to ``standard_errors`` without
            blocks.
        blocks: Number of blocks behind ``standard_errors``; 0 without blocks.
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
    responsibilities: Floats | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        return self._short(self.parameters.to_dict())

    def _rows(self) -> list[Row]:
        return [*super()._rows(), _offset("range_bias", self.range_bias, self.range_bias_error, self.bias_fitted)]

    def _counted(self) -> str:
        counts = f"{self.hits} hits and {self.max_readings} max readings"
        return f"{counts}; {self.missing} missing, {self.outliers} unexplained"

    def _search(self) -> str:
        return f"{self.method}, {self.iterations} iterations, {self.precision} on {self.device}"


@dataclass(frozen=True, eq=False, repr=False)
class LandmarkFit(Fitted[LandmarkParameters]):
    """Parameters of the landmark model, fitted by :func:`fit_landmark_parameters`.

    A standard deviation is None if no feature has this part; p_detect keeps its initial value unless it was counted.
    Densities are in 1/m, 1/rad and 1/unit of the signature. Standard errors come from the observed information;
    p_detect has the error of a share.

    Attributes:
        range_bias: Offset of ranges, r = d + offset: fitted with ``bias=True``, else the mean residual of features
            from landmarks; NaN without ranges [m].
        range_bias_error: Standard error of ``range_bias`` [m].
        bearing_bias: Offset of bearings, as for ranges [rad].
        bearing_bias_error: Standard error of ``bearing_bias`` [rad].
        bias_fitted: Whether the parameters were fitted together with the offsets.
        features: Number of features with at least one measured part.
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
    false: Floats = field(repr=False)

    def _rows(self) -> list[Row]:
        biases = [
            ("range_bias", self.range_bias, self.range_bias_error),
            ("bearing_bias", self.bearing_bias, self.bearing_bias_error),
        ]
        return [*super()._rows(), *(_offset(*bias, self.bias_fitted) for bias in biases if math.isfinite(bias[1]))]

    def _counted(self) -> str:
        counts = f"{self.features} features; {self.missing} missing, {self.false_positives:.1f} false positives"
        seen = f"\n{self.detected:.1f} of {self.expected} landmarks in view were seen"
        return counts + (seen if self.expected else "")


@dataclass(frozen=True, eq=False, repr=False)
class PointFit(Fitted[P]):
    """Parameters of a position, heading, beacon or bumper model, fitted to readings at known poses.

    Attributes:
        independent_errors: Standard errors for independent readings.
        values: Fitted parameters by the names in ``standard_errors``.
        readings: Number of used readings.
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

    def _value(self, name: str) -> float:
        return self.values[name]

    def _counted(self) -> str:
        return f"{self.readings} readings, {self.missing} missing"


@dataclass(frozen=True, eq=False, repr=False)
class DiscreteFit(PointFit[Any]):
    """Causes of a :class:`DiscreteBeamModel`, learned from readings.

    Log-likelihoods are of probabilities of bins, not of densities. Undetermined parameters have the standard error NaN.

    Attributes:
        hits: Number of readings with a range.
        max: Number of readings without a return.

    Example:
        >>> import gpusense as gs
        >>> table = gs.DiscreteBeamModel.learn([1.9, 2.0, 2.1, 5.0], [2.0, 2.0, 2.0, 2.0], range_max=5.0, bins=10)
        >>> table.fit.hits, table.fit.max, table.fit.missing
        (3, 1, 0)
    """

    hits: int
    max: int


def _offset(name: str, value: float, error: float, is_fitted: bool) -> Row:
    """Return the row of an offset; the parameters may exclude it."""
    return name, value, error, "fitted" if is_fitted else "estimated, not in the parameters"


def plain_fields(value: Any) -> dict[str, Any]:
    """Return the shown fields of a result as plain numbers, lists, strings and dictionaries of these."""
    return {one.name: _plain(getattr(value, one.name)) for one in fields(value) if one.repr}


def _plain(value: Any) -> Any:
    """Return parameters, arrays and mappings as dictionaries and lists of plain values."""
    if hasattr(value, "to_dict"):
        return value.to_dict()
    if isinstance(value, (np.ndarray, tuple)):
        return [_plain(one) for one in (value if isinstance(value, tuple) else value.tolist())]
    if isinstance(value, dict):
        return {name: _plain(number) for name, number in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _error_text(error: float) -> str:
    return f"{error:.3g}" if math.isfinite(error) else "inf" if error == math.inf else "-"


# Scaled information below this share of the largest counts as none.
_FLAT = 1e-10
# Standard errors over fewer blocks are rough.
FEW_BLOCKS = 10


def common_fields(
    log_likelihood: float, trace: Sequence[float], converged: bool, errors: dict[str, float], held: dict[str, str],
    notes: list[str], missing: int,
) -> dict[str, Any]:  # fmt: skip
    """Return the attributes that all results have, from the end of a search; ``notes`` come before ``held``."""
    unknown = [name for name, error in errors.items() if error == math.inf]
    held = held | dict.fromkeys(unknown, "the readings do not determine it")
    reasons = [
        f"{shortened([name for name in held if held[name] == reason])}: {reason}"
        for reason in dict.fromkeys(held.values())
    ]
    return dict(
        log_likelihood=log_likelihood, trace=np.array(trace), converged=converged, standard_errors=errors, held=held,
        iterations=len(trace) - 1, missing=missing,
        status="; ".join(["converged" if converged else "stopped", *notes, *reasons]),
    )  # fmt: skip


def shortened(names: list[str]) -> str:
    """Return the first names, and the number of further ones."""
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")


def number_blocks(blocks: object, shape: tuple[int, ...], of: NDArray[Any]) -> Integers | None:
    """Return the blocks of the used readings ``of`` (flat indices or mask), numbered from 0; None without blocks."""
    if blocks is None:
        return None
    labels: Integers = checks.array("blocks", blocks, shape, dtype=np.int64).ravel()
    known, numbers = np.unique(labels[of], return_inverse=True)
    if len(known) < 2:
        raise ValueError(f"blocks: must be at least 2 with a reading that is not missing, got {len(known)}")
    return numbers.ravel().astype(np.int64)


def notes_on_blocks(count: int) -> list[str]:
    """Return a note on standard errors over few blocks."""
    if count >= FEW_BLOCKS:
        return []
    return [f"standard errors are rough, from {count} {'block' if count == 1 else 'blocks'}"]


def scaled_axes(curve: Floats, least: float = 1e-300) -> tuple[Floats, Floats, Floats]:
    """Return (m,) scales of an (m, m) curvature to a unit diagonal (at least ``least``), its eigenvalues and axes."""
    scale = 1 / np.sqrt(np.maximum(np.abs(np.diag(curve)), least))
    size, axes = np.linalg.eigh(curve * np.outer(scale, scale))
    return scale, size, axes


def errors_of(curve: Floats, rows: Floats, scatter: Floats | None = None, flat: float = _FLAT) -> Floats:
    """Compute (p,) standard errors of functions with (p, m) derivatives ``rows``, infinite without information.

    The covariance of the coordinates is the inverse of the information H, or ``H^-1 S H^-1`` with the scatter S of the
    gradient over blocks (White 1982; Liang and Zeger 1986). Scaled information below the share ``flat`` counts as none.
    """
    if not len(curve):
        return np.full(len(rows), math.nan)
    scale, size, axes = scaled_axes(curve)
    known = size > flat * max(float(size[-1]), 0.0)
    errors = np.empty(len(rows))
    for k, row_of in enumerate(rows):
        row: Floats = axes.T @ (scale * row_of)
        unknown = np.abs(row[~known]) > math.sqrt(flat) * max(float(np.abs(row).max()), 1e-300)
        errors[k] = math.inf if unknown.any() else _error(row, size, known, scale[:, None] * axes, scatter)
    return errors


def scatter_of(sums: Floats) -> Floats:
    """Return the (m, m) scatter of the (B, m) gradients of blocks, centred; NaN for fewer than 2 blocks."""
    blocks, size = sums.shape
    if blocks < 2:
        return np.full((size, size), math.nan)
    off = sums - sums.sum(axis=0) / blocks
    return (off.T @ off) * (blocks / (blocks - 1))


def _error(row: Floats, size: Floats, known: NDArray[np.bool_], axes: Floats, scatter: Floats | None) -> float:
    """Return the error of a parameter from its (m,) derivatives along the (m, m) axes and the information there."""
    if scatter is None:
        return math.sqrt(float((row[known] ** 2 / size[known]).sum()))
    influence = axes[:, known] @ (row[known] / size[known])
    return math.sqrt(max(float(influence @ scatter @ influence), 0.0)) if np.isfinite(scatter).all() else math.nan
