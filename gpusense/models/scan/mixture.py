"""The beam model's mixture for kernels: flags of its components and its numbers, or a table instead."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from gpusense._util import checks
from gpusense.interface.constants import HIGH_PEAK, log_weight, rounded_terms, rounding_error, sums_linearly
from gpusense.interface.flags import flags_if
from gpusense.interface.structs import MixtureTerms, columns, packed
from gpusense.models.arguments import check_absent
from gpusense.world.hit_shapes import shape_of
from gpusense.world.hit_tables import mass_tables
from gpusense.world.parameters import BeamParameters, IncidenceParameters
from gpusense.world.range_causes import NoReturn, RandomDensity, ShortDensity
from gpusense.world.sensor_parameters import SensorTable

# Largest number of bins of a sensor's table along each axis: 268 MB in float32.
_MOST_BINS = 8192


@dataclass(frozen=True)
class Mixture:
    """The mixture of a beam model, as arguments of kernels."""

    flags: frozenset[str]  # flags of its components
    terms: MixtureTerms  # its numbers; each field is an array with a number for each bin of angles of incidence
    masses: np.ndarray  # tables of the masses of hits; one 0 without a table
    cosines: np.ndarray = field(default_factory=lambda: np.zeros(1))  # cosines between these bins
    # Log densities over readings and expected ranges; None where the mixture is evaluated.
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

    ``width``: width of the bins in which it is tabulated [m]; None evaluates it; ``compat``: the peer, or None.
    """
    mixtures, cosines = density.mixtures, density.cosines
    if compat is not None:
        return Mixture(*peer_mixture(mixtures[0], range_max, real, amcl=compat == "amcl"), np.zeros(1, real), cosines)
    flags, terms, masses = mixture_of(mixtures, range_max, real, specialize=specialize, max_depends=density.max_depends)
    if density.table is not None:
        values = density.table.sensor_table(real)
        # Sums of finite numbers need no check for impossible readings.
        flags = flags_if(SENSOR_TABLE=True, LINEAR=bool(np.isfinite(values).all()))
        return Mixture(flags, terms, masses, cosines, values)
    if width is None:
        return Mixture(flags, terms, masses, cosines)
    values = tabulated(mixtures[0], width, range_max, real)
    return Mixture((flags & {"LINEAR"}) | {"SENSOR_TABLE"}, terms, masses, cosines, values)


def mixture_of(
    kinds: Sequence[BeamParameters], range_max: float, real: np.dtype, *, specialize: bool, max_depends: bool
) -> tuple[frozenset[str], MixtureTerms, np.ndarray]:
    """Return flags of the components, their numbers for each bin of incidence, and the tables of masses of hits."""
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
    places, masses = mass_tables([shape_of(p) for p in kinds], real)
    terms = [_terms(p, range_max, real, linear, end, at) for p, end, at in zip(kinds, ends, places, strict=True)]
    return flags | shape, _columns(terms, real), masses


def learning_terms(p: BeamParameters, range_max: float, real: np.dtype) -> tuple[MixtureTerms, np.ndarray]:
    """Return the numbers of the kernel file ``learning``, and the table of masses of hits."""
    return _terms(p, range_max, real, False, None, 0), mass_tables([shape_of(p)], real)[1]


def _columns(terms: Sequence[MixtureTerms], real: np.dtype) -> MixtureTerms:
    """Return the numbers of all bins, with an array for each field."""
    made: MixtureTerms = columns("MixtureTerms", packed(terms, real))
    return made


def _common_flags(kinds: Sequence[BeamParameters]) -> frozenset[str]:
    """Return the flags of the shape of hits, which all bins of angles of incidence share."""
    shapes = {p.hit: shape_of(p).flags for p in kinds}
    if len(shapes) > 1:
        raise ValueError(f"hit: must be the same for all angles of incidence, got {sorted(shapes)}")
    return next(iter(shapes.values()))


def peer_mixture(
    p: BeamParameters, range_max: float, real: np.dtype, *, amcl: bool
) -> tuple[frozenset[str], MixtureTerms]:
    """Return flags and numbers of the kernel file ``compat``."""
    if p.range_bias or p.sigma_growth:
        raise ValueError(f"parameters: range_bias and sigma_growth must be 0 with compat, got {p}")
    flags = frozenset({"HIT", "SHORT", "RAND", "LINEAR", "CUBES"}) | flags_if(AMCL=amcl)
    hit = p.z_hit if amcl else hit_peak(p)
    short = ShortDensity(p.lambda_short)
    terms = rounded_terms(
        real, hit_peak=hit, **_scales(p), z_short=p.z_short, lambda_short=short.rate, rand_density=_rand(p, range_max),
        range_max=range_max, z_max=NoReturn(p.z_max).weight,
    )  # fmt: skip
    return flags, _columns([MixtureTerms(**dict.fromkeys(MixtureTerms._fields, 0.0) | terms)], real)


def tabulated(p: BeamParameters, width: float, range_max: float, real: np.dtype) -> np.ndarray:
    """Return log p in bins of readings and expected ranges, both with a last bin for range_max."""
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


def _scales(p: BeamParameters) -> dict[str, float]:
    """Return the factors of the squared distance in a normal's exponent and of a distance in erf."""
    return {"square_scale": 0.5 / p.sigma_hit / p.sigma_hit, "erf_scale": math.sqrt(0.5) / p.sigma_hit}


def _terms(
    p: BeamParameters,
    range_max: float,
    real: np.dtype,
    linear: bool,
    end: tuple[float, float, float] | None,
    place: int,
) -> MixtureTerms:
    shape = shape_of(p)
    if linear:
        hit, short, rand = hit_peak(p), p.z_short, _rand(p, range_max)
    else:
        hit = log_weight(p.z_hit) - math.log(p.sigma_hit) - shape.log_width
        short, rand = log_weight(p.z_short), RandomDensity(range_max).log_peak(p.z_rand)
    rounded = rounded_terms(
        real, hit_peak=hit, **_scales(p), z_short=short, lambda_short=ShortDensity(p.lambda_short).rate,
        rand_density=rand, range_max=range_max, z_max=NoReturn(p.z_max).number,
    )  # fmt: skip
    offset, slope, least = end or (0.0, 0.0, 0.0)
    power, rate = shape.numbers
    return MixtureTerms(
        **rounded, **_moments(p, real), last_offset=offset, last_slope=slope, last_least=least,
        inverse_sigma=1 / p.sigma_hit, unit_peak=1 / shape.width, shape_power=power, shape_rate=rate, mass_table=place,
    )  # fmt: skip


def _last_range(p: BeamParameters, range_max: float, real: np.dtype, linear: bool) -> tuple[float, float, float] | None:
    """Return (offset, slope, least) of a range from which on log p is constant to the last bit; None without it.

    It is ``max(offset + slope z, least)`` for a reading z. From there on p_hit, divided by its mass, is at most
    2^-(digits + 3) p_rand: ``z* + bias - z >= u (sigma_hit + sigma_growth z*)`` with u from the peak over p_rand. An
    offset above 0 only moves the mean farther away. p_short's normaliser is constant where ``exp(-lambda_short z*)`` is
    below half of the last bit of 1.
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


def _moments(p: BeamParameters, real: np.dtype) -> dict[str, np.floating]:
    """Return range_bias and sigma_growth / sigma_hit, each as a rounded number and its rounding error."""
    moments = {"range_bias": p.range_bias, "relative_growth": p.sigma_growth / p.sigma_hit}
    with np.errstate(over="ignore"):
        rounded = {name: real.type(moment) for name, moment in moments.items()}
    if not np.isfinite(list(rounded.values())).all():
        raise ValueError(f"parameters: range_bias and sigma_growth / sigma_hit must fit {real.name}, got {p}")
    return rounded | {f"{name}_low": rounding_error(moments[name], rounded[name]) for name in moments}


# ---- the density of a beam model: parameters for each bin of angles of incidence, or the table of a sensor


# Between 1, the largest cosine, and 2, which kernels use for a ray without a return.
_BEYOND = 1.5


@dataclass(frozen=True)
class BeamDensity:
    """The density of a beam model."""

    mixtures: tuple[BeamParameters, ...]  # parameters of each bin in the kernels' order, first for beams without a hit
    cosines: np.ndarray  # cosines between the bins
    incidence: IncidenceParameters | None = None  # the parameters by angle of incidence, or None
    table: SensorTable | None = None  # the table of a sensor in place of the mixtures, or None

    @property
    def parameters(self) -> BeamParameters | SensorTable | None:
        """The mixture, or the table of a sensor; None where parameters depend on the angle of incidence."""
        if self.incidence is not None:
            return None
        return self.mixtures[0] if self.table is None else self.table

    @property
    def max_depends(self) -> bool:
        """Return whether the probability of a max reading depends on the pose."""
        return self.table is not None or len({p.z_max for p in self.mixtures}) > 1

    @property
    def z_max(self) -> float:
        """Largest probability of a max reading; 1 for a table."""
        return max(p.z_max for p in self.mixtures) if self.table is None else 1.0

    @property
    def possible(self) -> bool:
        """Return whether ranges can be possible. If ``max_depends``, the kernel detects impossible ranges."""
        return self.max_depends or any(p.z_hit or p.z_short or p.z_rand for p in self.mixtures)


def density_of(parameters: object, default: BeamParameters, incidence: object, **options: object) -> BeamDensity:
    """Return the density that the arguments of a beam model choose; ``options`` must be None with ``incidence``."""
    table = parameters if isinstance(parameters, SensorTable) else None
    # A table of a sensor replaces the mixture.
    mixture = default if parameters is None or table else parameters
    if not isinstance(mixture, BeamParameters):
        rule = "must be BeamParameters or a DiscreteBeamModel"
        raise TypeError(f"parameters: {rule}, got {checks.show(parameters)}")
    if incidence is None:
        return BeamDensity((mixture,), np.zeros(1), table=table)
    bins = checks.instance("incidence", incidence, IncidenceParameters)
    check_absent("with incidence", parameters=parameters, **options)
    cosines = np.cos(bins.edges[1:])
    if bins.no_surface is None:
        return BeamDensity(bins.parameters, cosines, bins)
    return BeamDensity((bins.no_surface, *bins.parameters), np.append(_BEYOND, cosines), bins)
