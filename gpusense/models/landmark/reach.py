"""Discs that bound the landmarks that can matter to a feature."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gpusense.models.landmark.sensor import Sensor
from gpusense.world.parameters import LandmarkParameters


@dataclass(frozen=True)
class Reach:
    """Bounds of the landmarks that can matter to a feature.

    Attributes:
        reach: Distance of the disc's centre along the bearing [m].
        radius: Radius of the disc [m]; negative where no landmark matters.
        hole: Least distance from the sensor [m].
    """

    reach: float
    radius: float
    hole: float


def reach_of(p: LandmarkParameters, sensor: Sensor, z: float, measured: np.ndarray, bound: float) -> Reach:
    """Return the disc outside which exponents are larger than ``bound``.

    Args:
        p: Deviations and limits.
        sensor: Constants of the sensor.
        z: The range; not read where it was not measured.
        measured: Whether range, bearing and signature were measured.
        bound: Largest exponent that matters; infinite where all do.
    """
    if bound < 0:
        return Reach(0.0, -1.0, 0.0)
    wide = math.sqrt(bound)
    near, far = 0.0, p.range_max
    if measured[0]:
        near, far = max(z - wide / sensor.scales[0], 0.0), z + wide / sensor.scales[0]
    elif not measured[1]:
        return Reach(0.0, far, 0.0)
    angle = min(wide / sensor.scales[1], math.pi) if measured[1] else math.pi
    around = Reach(0.0, far, near)
    if not measured[1]:
        return around
    if math.isinf(far):
        # All landmarks may matter until one is likelier than all beyond some distance.
        return Reach(z, far, 0.0)
    # Of the points of a ring's sector, a corner is farthest from its middle.
    if measured[0]:
        ahead = z
    else:
        ahead = far / (2 * math.cos(angle)) if angle <= math.pi / 4 else far * math.cos(min(angle, math.pi / 2))
    cosine = math.cos(angle)
    radius = math.sqrt(max(max(ahead**2 + d**2 - 2 * ahead * d * cosine for d in (near, far)), 0.0))
    if not measured[0]:
        radius = max(radius, abs(far - ahead))
    return Reach(ahead, radius, near) if radius < far else around
