"""A shape of hits that is not in the package: Student's t with 3 degrees of freedom, 1.7 times as wide.

``same`` describes the same density by a shape of the package: every user of densities must return equal results.
"""

from __future__ import annotations

import math

import numpy as np

from gpusense.world.hit_shapes import StudentHit

FACTOR, DOF = 1.7, 3.0


class MadeUpHit(StudentHit):
    """The shape; kernels get only its numbers."""

    fitted = ()
    limits = ()
    starts = ((0.3,), (1.0,))

    @classmethod
    def of(cls, parameters):
        return cls(DOF)

    @classmethod
    def at(cls, coordinates):
        return cls(DOF)

    @property
    def coordinates(self):
        return np.zeros(0)

    def values(self):
        return {}

    @property
    def log_width(self):
        return super().log_width + math.log(FACTOR)

    @property
    def numbers(self):
        power, rate = super().numbers
        return power, rate / FACTOR**2

    def exponent(self, u):
        return super().exponent(u / FACTOR)

    def slope(self, u):
        return super().slope(u / FACTOR) / FACTOR

    def reach(self, exponent):
        return FACTOR * super().reach(exponent)

    def half_mass(self, u):
        return super().half_mass(np.asarray(u) / FACTOR)

    def quantile(self, level):
        return FACTOR * super().quantile(level)


def made_up(parameters, name="made-up"):
    """Return parameters with hits of the made-up shape."""
    return parameters.replace(hit=name)


def same(parameters):
    """Return parameters of the same density by Student's t."""
    return parameters.replace(hit="student", hit_dof=DOF, sigma_hit=FACTOR * parameters.sigma_hit)
