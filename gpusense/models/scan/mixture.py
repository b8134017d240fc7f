"""The beam model's mixture for kernels: flags of its components and its numbers, or a table instead."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from gpusense._util import checks
from gpusense.interface.flags import flags_if
from gpusense.interface.terms import HIGH_PEAK, log_weight, rounded_terms, sums_linearly
from gpusense.models.scan.beam_density import BeamDensity
from gpusense.world.hit_shapes import shape_of
from gpusense.world.hit_tables import mass_tables
from gpusense.world.parameters import BeamParameters
from gpusense.world.range_causes import NoReturn, RandomDensity, ShortDensity

# Largest number of bins of a sensor's table along each axis: 268 MB in float32.
_MOST_BINS = 8192


@dataclass(frozen=True)
class Mixture:
    """The mixture of a beam model, as arguments of kernels.

    Attributes:
        flags: Flags of its components.
        terms: Its numbers, for each bin of angles of incidence.
        cosines: Cosines between these bins.
        table: Log densities over readings and expected ranges; None where the mixture is evaluated.
    """

    flags: frozenset[str]
    terms: np.ndarray
    cosines: np.ndarray = field(default_factory=lambda: np.zeros(1))
    table: np.ndarray | None = None

    @property
    def bins(self) -> int:
        """Bins of angles of incidence."""
        return len(self.cosines)

    @property
    def cells(self) -> int:
        """Bins of a range in the table; 0 without one."""
        return 0 if self.table is None else len(self.table) - 1


def mixture_on_device(
    density: BeamDensity,
    range_max: float,
    real: np.dtype,
    *,
    width: float | None,
    compat: str | None,
    specialize: bool,
) -> Mixture:
    """Return a beam model's mixture as arguments of kernels.

    Args:
        density: The density.
        range_max: Longest range [m].
        real: Precision.
        width: Width of the bins in which the mixture is tabulated [m]; None evaluates it.
        compat: The program whose weights are reproduced, or None.
        specialize: False leaves nothing out.

    Raises:
        ValueError: A number is beyond what the precision can hold.
        TypeError, ValueError: A width that is not a number, too small or more than range_max.
    """
    mixtures, cosines = density.mixtures, density.cosines
    if compat is not None:
        return Mixture(*peer_mixture(mixtures[0], range_max, real, amcl=compat == "amcl"), cosines)
    flags, terms = mixture_of(mixtures, range_max, real, specialize=specialize, max_depends=density.max_depends)
    if density.table is not None:
        values = density.table.sensor_table(real)
        # Sums of finite numbers need no check for impossible readings.
        flags = flags_if(SENSOR_TABLE=True, LINEAR=bool(np.isfinite(values).all()))
        return Mixture(flags, terms, cosines, values)
    if width is None:
        return Mixture(flags, terms, cosines)
    values = tabulated(mixtures[0], width, range_max, real)
    return Mixture((flags & {"LINEAR"}) | {"SENSOR_TABLE"}, terms, cosines, values)


def mixture_of(
    kinds: Sequence[BeamParameters], range_max: float, real: np.dtype, *, specialize: bool, max_depends: bool
) -> tuple[frozenset[str], np.ndarray]:
    """Return flags of the components, and the numbers of the kernel file ``mixture`` for each bin of incidence.

    Raises:
        ValueError: A number is beyond what the precision can hold.
    """
    hit, short, rand = (max(getattr(p, name) for p in kinds) > 0 for name in ("z_hit", "z_short", "z_rand"))
    # If no range is possible at any angle, a component must evaluate to -inf.
    rand |= max_depends and not (hit or short)
    peaks, everything = [hit_peak(p) for p in kinds], not specialize
    linear = all(
        sums_linearly(_rand(p, range_max), max(peak, ShortDensity(p.lambda_short).peak(p.z_short)), real)
        for p, peak in zip(kinds, peaks, strict=True)
    )
    ends = [_last_range(p, range_max, real, linear) for p in kinds]
    shape = _common_flags(kinds)
    flags = flags_if(
        HIT=hit or everything, SHORT=short or everything, RAND=rand or everything,
        BIAS=everything or any(p.range_bias for p in kinds), GROWTH=everything or any(p.sigma_growth for p in kinds),
        SINGLE=specialize and hit + short + rand == 1, EXACT_EXPONENT=max(peaks) > HIGH_PEAK or everything,
        LINEAR=linear,
        STOPS=specialize and len(ends) == 1 and ends[0] is not None,
    )  # fmt: skip
    terms = [_terms(p, range_max, real, linear, end) for p, end in zip(kinds, ends, strict=True)]
    return flags | shape, np.concatenate([*terms, *mass_tables([shape_of(p) for p in kinds], terms, real)])


def learning_terms(p: BeamParameters, range_max: float, real: np.dtype) -> np.ndarray:
    """Return the numbers of the kernel file ``learning``, with the table of masses behind them.

    Raises:
        ValueError: A number is beyond what the precision can hold.
    """
    shape = shape_of(p)
    terms = _terms(p, range_max, real, False, (1 / p.sigma_hit, 1 / shape.width, 0.0))
    return np.concatenate([terms, *mass_tables([shape], [terms], real)])


def _common_flags(kinds: Sequence[BeamParameters]) -> frozenset[str]:
    """Return the flags of the shape of hits, which all bins of angles of incidence share."""
    shapes = {p.hit: shape_of(p).flags for p in kinds}
    if len(shapes) > 1:
        raise ValueError(f"hit: must be the same for all angles of incidence, got {sorted(shapes)}")
    return next(iter(shapes.values()))


def peer_mixture(
    p: BeamParameters, range_max: float, real: np.dtype, *, amcl: bool
) -> tuple[frozenset[str], np.ndarray]:
    """Return flags and numbers of the kernel file ``compat``.

    Raises:
        ValueError: A number is beyond what the precision can hold.
    """
    if p.range_bias or p.sigma_growth:
        raise ValueError(f"parameters: range_bias and sigma_growth must be 0 with compat, got {p}")
    flags = frozenset({"HIT", "SHORT", "RAND", "LINEAR", "CUBES"}) | flags_if(AMCL=amcl)
    hit = p.z_hit if amcl else hit_peak(p)
    short = ShortDensity(p.lambda_short)
    terms = [hit, *_shape(p), p.z_short, short.rate, _rand(p, range_max), range_max, NoReturn(p.z_max).weight]
    return flags, rounded_terms(terms, real)


def tabulated(p: BeamParameters, width: float, range_max: float, real: np.dtype) -> np.ndarray:
    """Return log p in bins of readings and expected ranges, both with a last bin for range_max.

    Raises:
        TypeError, ValueError: A width that is not a number, too small or more than range_max.
    """
    from gpusense.models.scan.densities import log_mixture  # loads SciPy

    width = checks.real("sensor_table", width, low=range_max / _MOST_BINS, high=range_max)
    cells = max(round(range_max / width), 1)
    middle = (np.arange(cells) + 0.5) * (range_max / cells)
    expected = np.append(middle, range_max)
    table = np.full((cells + 1, cells + 1), NoReturn(p.z_max).number, real)
    # In blocks of rows: temporary arrays take about forty numbers per density.
    for first in range(0, cells, 64):
        rows = slice(first, first + 64)
        table[:-1][rows] = log_mixture(middle[rows, None], expected, range_max=range_max, **p.to_dict())
    return table


def hit_peak(p: BeamParameters) -> float:
    """Return the peak of the hit density times its weight [1/m]."""
    return shape_of(p).peak(p.z_hit, p.sigma_hit)


def _rand(p: BeamParameters, range_max: float) -> float:
    """Return the density of random readings times their weight [1/m]."""
    return RandomDensity(range_max).peak(p.z_rand)


def _shape(p: BeamParameters) -> tuple[float, float]:
    return 0.5 / p.sigma_hit / p.sigma_hit, math.sqrt(0.5) / p.sigma_hit


def _terms(
    p: BeamParameters, range_max: float, real: np.dtype, linear: bool, end: tuple[float, float, float] | None
) -> np.ndarray:
    if linear:
        head = (hit_peak(p), p.z_short, _rand(p, range_max))
    else:
        log_scale = log_weight(p.z_hit) - math.log(p.sigma_hit) - shape_of(p).log_width
        head = (log_scale, log_weight(p.z_short), RandomDensity(range_max).log_peak(p.z_rand))
    rate, top = ShortDensity(p.lambda_short).rate, NoReturn(p.z_max).number
    terms = [head[0], *_shape(p), head[1], rate, head[2], range_max, top]
    # The last number is the place of the table of masses.
    rest = [*(end or (0, 0, 0)), *shape_of(p).numbers, 0]
    return np.concatenate([rounded_terms(terms, real), _moments(p, real), np.array(rest, real)])


def _last_range(p: BeamParameters, range_max: float, real: np.dtype, linear: bool) -> tuple[float, float, float] | None:
    """Return the numbers (offset, slope, least) of an expected range from which on log p is constant to the last bit.

    It is ``max(offset + slope z, least)`` for a reading z. From there on p_hit, divided by its mass, is at most
    2^-(digits + 3) p_rand: ``z* + bias - z >= u (sigma_hit + sigma_growth z*)`` with u from the peak over p_rand. An
    offset above 0 only moves the mean farther away. p_short's normaliser is constant where ``exp(-lambda_short z*)`` is
    below half of the last bit of 1.

    Returns:
        None if some reading has no such range below range_max.
    """
    rand, digits = _rand(p, range_max), np.finfo(real).nmant
    if not rand or (p.z_short and not (linear and p.lambda_short)):
        return None
    least = ShortDensity(p.lambda_short).settled(digits + 9) if p.z_short else 0.0
    offset, slope = 0.0, 1.0
    if p.z_hit:
        widest = p.sigma_hit + p.sigma_growth * range_max
        mass = float(shape_of(p).half_mass(np.array([range_max / widest]))[0])
        excess = math.log(hit_peak(p)) - math.log(mass * rand) + (digits + 3) * math.log(2)
        u = shape_of(p).reach(max(excess, 0.0))
        if u * p.sigma_growth >= 0.5:
            return None
        slope = 1 / (1 - u * p.sigma_growth)
        offset = (u * p.sigma_hit + max(-p.range_bias, 0.0)) * slope
    # A margin that exceeds the rounding errors of ranges.
    slope, offset = slope * 1.0001, offset * 1.0001 + 1e-6 * range_max
    return (offset, slope, least) if max(offset, least) < range_max else None


def _moments(p: BeamParameters, real: np.dtype) -> np.ndarray:
    """Return range_bias and sigma_growth / sigma_hit, each as a rounded number and its rounding error."""
    exact = np.array([p.range_bias, p.sigma_growth / p.sigma_hit])
    with np.errstate(over="ignore"):
        rounded = exact.astype(real)
    if not np.isfinite(rounded).all():
        raise ValueError(f"parameters: range_bias and sigma_growth / sigma_hit must fit {real.name}, got {p}")
    return np.stack([rounded, (exact - rounded).astype(real)], axis=1).ravel()
