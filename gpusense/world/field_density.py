"""Evaluate the density of a likelihood field on the host (*Probabilistic Robotics* table 6.3).

    p(d) = z_hit f(d) + z_rand / range_max

for the distance d [m] from the end point of a reading to the nearest obstacle, with f the density of a hit of scale
sigma_hit around 0 (``world.hit_shapes``). This is the host's only copy of the formula; kernels repeat it in their
languages and take their numbers from here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gpusense._util.typing import Floats
from gpusense.interface.constants import HIGH_PEAK, log_weight, rounded_terms, sums_linearly
from gpusense.interface.structs import FieldTerms
from gpusense.world.hit_shapes import HitShape, shape_of
from gpusense.world.parameters import LikelihoodFieldParameters
from gpusense.world.range_causes import NoReturn, RandomDensity


@dataclass(frozen=True)
class FieldDensity:
    """Density of a likelihood field with these parameters."""

    parameters: LikelihoodFieldParameters  # parameters of the field
    range_max: float  # longest range of the scanner [m]

    @property
    def sigma(self) -> float:
        """Scale of hits [m]: the standard deviation of a normal."""
        return self.parameters.sigma_hit

    @property
    def shape(self) -> HitShape:
        """Shape of the density of hits."""
        return shape_of(self.parameters)

    @property
    def flags(self) -> frozenset[str]:
        """Flags of the shape in kernels that evaluate the density."""
        return self.shape.flags - {"MASS_TABLE"}

    @property
    def peak(self) -> float:
        """Weighted density of a hit at distance 0 [1/m]; 0 for a weight of 0."""
        return self.shape.peak(self.parameters.z_hit, self.sigma)

    @property
    def log_peak(self) -> float:
        """Logarithm of ``peak``; finite also where ``peak`` underflows."""
        return log_weight(self.parameters.z_hit) - math.log(self.sigma) - self.shape.log_width

    @property
    def rate(self) -> float:
        """Factor of the squared distance in the exponent of a normal [1/m^2]."""
        return 0.5 / self.sigma / self.sigma

    @property
    def rand(self) -> float:
        """Weighted density of random readings [1/m]."""
        return RandomDensity(self.range_max).peak(self.parameters.z_rand)

    @property
    def log_rand(self) -> float:
        """Logarithm of ``rand``."""
        return RandomDensity(self.range_max).log_peak(self.parameters.z_rand)

    @property
    def is_sharp(self) -> bool:
        """Return whether kernels need the exponent in two parts, because the density has a sharp peak."""
        return self.peak > HIGH_PEAK

    def is_linear(self, real: np.dtype) -> bool:
        """Return whether kernels sum densities rather than logarithms."""
        return sums_linearly(self.rand, self.peak, real)

    def terms(self, real: np.dtype) -> FieldTerms:
        """Return the numbers of the kernel file ``field_term``, for a sum of densities or of logarithms."""
        hit, rand = (self.peak, self.rand) if self.is_linear(real) else (self.log_peak, self.log_rand)
        top, (power, rate) = NoReturn(self.parameters.z_max).number, self.shape.numbers
        terms = rounded_terms(real, hit_peak=hit, square_scale=self.rate, rand_density=rand, z_max=top)
        return FieldTerms(**terms, shape_power=power, shape_rate=rate)

    def capped(self, distance: Floats) -> Floats:
        """Return distances, clamped to ``max_distance``."""
        return np.minimum(distance, self.parameters.max_distance)

    def log(self, distance: Floats) -> Floats:
        """Return the log density [log 1/m] at distances [m], without clamping them."""
        with np.errstate(over="ignore"):
            exponent = self.shape.exponent(distance / self.sigma)
        return np.logaddexp(self.log_peak - exponent, self.log_rand)
