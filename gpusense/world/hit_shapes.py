"""Evaluate densities of a correct range on the host, and derive the numbers that kernels need.

A hit of scale sigma has the density ``exp(-E(u)) / (width sigma)`` at u = (z - mean) / sigma; it is symmetric and falls
with |u|. Models weight it, mix it with other causes, and may truncate it to [0, range_max]. Host code uses it only
through :class:`HitShape`. Kernels implement E in their file ``hit_shape`` and get all other numbers here.

A shape is registered in :data:`SHAPES` under its name, the value of ``hit=`` in the parameters of scan models. The
recipe for another shape is in CONTRIBUTING.md.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self, TypeAlias, cast

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[Any]
HitName: TypeAlias = Literal["normal", "student"]

# Bounds of the degrees of freedom of Student's t; at the largest it equals the normal in float32.
LEAST_DOF, MOST_DOF = 1.0, 1e6
# Half degrees of freedom above which the ratio of gamma functions is computed by its asymptotic series.
_SERIES_FROM = 30.0
# erf(x) is 1 in float64 from this x on.
_ERF_IS_ONE = 6.0
# The largest number below one half.
_MOST_HALF = math.nextafter(0.5, 0)


class HitShape(ABC):
    """The density of a correct range, of scale 1 around 0.

    A subclass has at most one fitted parameter, since fits on a device move a single coordinate.

    Attributes:
        flags: Flags of the kernels that evaluate it.
        tabulated: Whether kernels look up the mass in a table of ``half_mass``.
        fitted: Names of the fitted parameters, without the scale.
        limits: (P, 2) smallest and largest coordinate of a fit; P is 0 or 1.
        starts: (S, P + 1) coordinates from which a fit starts, each with a factor for the scale of the fitted normal.
    """

    flags: ClassVar[frozenset[str]]
    tabulated: ClassVar[bool] = True
    fitted: ClassVar[tuple[str, ...]] = ()
    limits: ClassVar[tuple[tuple[float, float], ...]] = ()
    starts: ClassVar[tuple[tuple[float, ...], ...]] = ((1.0,),)

    def __init_subclass__(cls) -> None:
        """Check the numbers of fitted parameters, limits and coordinates of starts."""
        super().__init_subclass__()
        counts = {len(cls.fitted), len(cls.limits), *(len(start) - 1 for start in cls.starts)}
        if len(counts) > 1 or max(counts) > 1:
            raise TypeError(
                f"{cls.__name__}: must have at most one fitted parameter, with limits and a coordinate of each start, "
                f"got fitted={cls.fitted}, limits={cls.limits}, starts={cls.starts}"
            )

    @classmethod
    @abstractmethod
    def of(cls, parameters: Any) -> Self:
        """Make the shape that parameters of a scan model describe."""

    @classmethod
    def at(cls, coordinates: Floats) -> Self:
        """Make the shape at coordinates of a fit."""
        return cls()

    @property
    def coordinates(self) -> Floats:
        """The (P,) coordinates at which ``at`` makes this shape."""
        return np.zeros(0)

    def values(self) -> dict[str, float]:
        """Return the values of the fitted parameters by name."""
        return {}

    @property
    @abstractmethod
    def width(self) -> float:
        """Inverse of the density at 0."""

    @property
    @abstractmethod
    def log_width(self) -> float:
        """Logarithm of ``width``."""

    @property
    def numbers(self) -> tuple[float, float]:
        """Return the numbers of the kernel file ``hit_shape``."""
        return 0.0, 0.0

    @abstractmethod
    def exponent(self, u: Floats) -> Floats:
        """Return E(u), minus the log of the ratio of the density to its value at 0."""

    @abstractmethod
    def slope(self, u: Floats) -> Floats:
        """Return the derivative E'(u)."""

    @abstractmethod
    def reach(self, exponent: float) -> float:
        """Return the u >= 0 at which E is ``exponent`` >= 0."""

    @abstractmethod
    def half_mass(self, u: Floats) -> Floats:
        """Return the mass between 0 and u >= 0; small values keep their digits."""

    @abstractmethod
    def drawn(self, share: Floats, low: Floats, high: Floats) -> Floats:
        """Return the quantile u of a share of the mass between -low <= 0 and high >= 0."""

    @abstractmethod
    def quantile(self, level: Floats) -> Floats:
        """Return the u >= 0 for which the mass between 0 and u is (1 - exp(-level)) / 2."""

    def peak(self, weight: float, sigma: float) -> float:
        """Return a weight times the density at the mean [1/m]."""
        return weight / (sigma * self.width)

    def log_pdf(self, u: Floats) -> Floats:
        """Return the log density."""
        with np.errstate(over="ignore"):
            return -self.exponent(u) - self.log_width


@dataclass(frozen=True)
class NormalHit(HitShape):
    """The normal density, equation 6.4 of *Probabilistic Robotics*: E = u^2 / 2."""

    flags = frozenset()
    tabulated = False

    @classmethod
    def of(cls, parameters: Any) -> Self:
        return cls()

    @property
    def width(self) -> float:
        return math.sqrt(2 * math.pi)

    @property
    def log_width(self) -> float:
        return 0.5 * math.log(2 * math.pi)

    def exponent(self, u: Floats) -> Floats:
        return 0.5 * u**2

    def slope(self, u: Floats) -> Floats:
        return u

    def reach(self, exponent: float) -> float:
        return math.sqrt(2 * exponent)

    def half_mass(self, u: Floats) -> Floats:
        scaled = u * u.dtype.type(math.sqrt(0.5))
        if scaled.min(initial=np.inf) >= _ERF_IS_ONE:
            # Avoid SciPy here: importing it takes as long as a call of a model.
            return np.full_like(scaled, 0.5)
        from scipy.special import erf

        return u.dtype.type(0.5) * erf(scaled)

    def drawn(self, share: Floats, low: Floats, high: Floats) -> Floats:
        from scipy.special import ndtr, ndtri

        below = ndtr(-low)
        return np.asarray(ndtri(below + share * (ndtr(high) - below)))

    def quantile(self, level: Floats) -> Floats:
        from scipy.special import erfcinv, erfinv

        root = np.where(level < math.log(2), erfinv(-np.expm1(-level)), erfcinv(np.exp(-level)))
        return math.sqrt(2) * root


@dataclass(frozen=True)
class StudentHit(HitShape):
    """Student's t with ``dof`` degrees of freedom; its heavy tails explain readings that a normal makes impossible.

    E = (dof + 1) / 2 log(1 + u^2 / dof); with infinite dof it is the normal. It is a normal whose inverse variance is
    drawn from a gamma distribution (Lange, Little and Taylor, "Robust statistical modeling using the t distribution",
    1989).
    """

    dof: float

    flags = frozenset({"STUDENT", "MASS_TABLE"})
    fitted = ("hit_dof",)
    # The coordinate is 1 / dof, so that the normal is an end of a finite interval.
    limits = ((1 / MOST_DOF, 1 / LEAST_DOF),)
    starts = ((0.8, 0.4), (0.3, 0.7), (0.03, 1.0))

    @classmethod
    def of(cls, parameters: Any) -> Self:
        return cls(parameters.hit_dof)

    @classmethod
    def at(cls, coordinates: Floats) -> Self:
        return cls(min(max(1 / float(coordinates[0]), LEAST_DOF), MOST_DOF))

    @property
    def coordinates(self) -> Floats:
        return np.array([1 / self.dof])

    def values(self) -> dict[str, float]:
        return {"hit_dof": self.dof}

    @property
    def width(self) -> float:
        return math.exp(self.log_width)

    @property
    def log_width(self) -> float:
        """See HitShape.log_width: log(sqrt(2 pi a) gamma(a) / gamma(a + 1/2)) with a = dof / 2."""
        a = 0.5 * self.dof
        if a < _SERIES_FROM:
            return 0.5 * math.log(2 * math.pi * a) + math.lgamma(a) - math.lgamma(a + 0.5)
        x = 1 / a
        series = x * (-1 / 8 + x**2 * (1 / 192 - x**2 * (1 / 640 - x**2 * (17 / 14336 - x**2 * 31 / 18432))))
        return 0.5 * math.log(2 * math.pi) - series

    @property
    def numbers(self) -> tuple[float, float]:
        """See HitShape.numbers: the power, and the factor of u^2 / 2."""
        return 0.5 * (self.dof + 1), 2 / self.dof

    def exponent(self, u: Floats) -> Floats:
        return 0.5 * (self.dof + 1) * np.log1p(u * u / self.dof)

    def slope(self, u: Floats) -> Floats:
        return (self.dof + 1) * u / (self.dof + u * u)

    def reach(self, exponent: float) -> float:
        return math.sqrt(self.dof * math.expm1(min(2 * exponent / (self.dof + 1), 700.0)))

    def half_mass(self, u: Floats) -> Floats:
        return _student_half_mass(u, self.dof)

    def drawn(self, share: Floats, low: Floats, high: Floats) -> Floats:
        below = self.half_mass(low)
        mark = share * (below + self.half_mass(high)) - below
        level = -np.log1p(-2 * np.minimum(np.abs(mark), _MOST_HALF))
        return np.clip(np.copysign(self.quantile(level), mark), -low, high)

    def quantile(self, level: Floats) -> Floats:
        from scipy.special import betaincinv

        # Invert the incomplete beta function from its nearer end; this keeps all digits for small and large dof.
        middle = 3.0
        near = betaincinv(0.5, 0.5 * self.dof, -np.expm1(-np.minimum(level, middle)))
        far = betaincinv(0.5 * self.dof, 0.5, np.exp(-np.maximum(level, middle)))
        return np.sqrt(self.dof * np.where(level < middle, near / (1 - near), (1 - far) / far))


def _student_half_mass(u: Floats, dof: float) -> Floats:
    """Return the mass of Student's t between 0 and u >= 0, by the incomplete beta function or its complement."""
    from scipy.special import betainc

    u = np.asarray(u)
    with np.errstate(over="ignore", invalid="ignore"):
        ratio = u * u / u.dtype.type(dof)
        share = np.where(np.isinf(ratio), 1, ratio / (1 + ratio))
    half, is_near = u.dtype.type(0.5), ratio < 1
    mass = np.empty_like(u)
    mass[is_near] = half * betainc(0.5, 0.5 * dof, share[is_near])
    mass[~is_near] = half - half * betainc(0.5 * dof, 0.5, 1 / (1 + ratio[~is_near]))
    return mass


SHAPES: dict[str, type[HitShape]] = {"normal": NormalHit, "student": StudentHit}
NORMAL = NormalHit()
# Parameters of scan models that describe a shape, apart from its scale.
SHAPE_PARAMETERS = ("hit", *dict.fromkeys(name for shape in SHAPES.values() for name in shape.fitted))


def name_of(shape: HitShape) -> HitName:
    """Return the name of a shape in parameters."""
    return cast("HitName", next(name for name, kind in SHAPES.items() if kind is type(shape)))


def shape_of(parameters: Any) -> HitShape:
    """Return the hit shape of a scan model's parameters."""
    return SHAPES[parameters.hit].of(parameters)
