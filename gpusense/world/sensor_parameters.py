"""Intrinsic parameters of position, heading, beacon, bumper and line models: frozen, validated dataclasses."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

from gpusense._util import checks
from gpusense.world.parameters import _Parameters

# Largest degrees of freedom: up to here the mass of Student's t is a short sum; beyond, the t is nearly normal.
MOST_DEGREES = 100
# Largest standard deviation of a line's angle [rad]: a ninth of half a turn.
LARGEST_ANGLE_DEVIATION = 0.349


def check_covariance(name: str, value: object) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return ``value`` after checking that it is a symmetric positive definite 2 x 2 matrix."""
    c = checks.array(name, value, (2, 2))
    if abs(c[0, 1] - c[1, 0]) > 1e-9 * math.sqrt(abs(c[0, 0])) * math.sqrt(abs(c[1, 1])):
        raise ValueError(f"{name}: must be symmetric, got {checks.show(c.tolist())}")
    xx, yy, off = float(c[0, 0]), float(c[1, 1]), float(c[0, 1] / 2 + c[1, 0] / 2)
    # Exact arithmetic, because models take the square root of the difference.
    if not (xx > 0 and yy > 0 and Fraction(off) ** 2 < Fraction(xx) * Fraction(yy)):
        raise ValueError(f"{name}: must be positive definite, got {checks.show(c.tolist())}")
    return (xx, off), (off, yy)


def _check_mount(parameters: object, value: object) -> None:
    x, y = checks.array("mount", value, (2,))
    object.__setattr__(parameters, "mount", (float(x), float(y)))


@dataclass(frozen=True)
class PositionParameters(_Parameters):
    """Parameters of position fixes, for example from a satellite receiver.

    Raises:
        TypeError: A value has the wrong type for its field.
        ValueError: A value breaks its field's rule, both sigma and covariance are set, or the weights do not sum to 1
            within 1e-6.

    Example:
        >>> import gpusense as gs
        >>> gs.PositionParameters(sigma=2.0, z_hit=0.9, z_rand=0.1, region=(0, 0, 100, 50)).region
        (0.0, 0.0, 100.0, 50.0)
    """

    sigma: float | None = None
    """Standard deviation along x and along y, > 0 [m]."""
    covariance: tuple[tuple[float, float], tuple[float, float]] | None = None
    """Covariance matrix in the world instead of sigma [m^2]; without either, each measurement states its
    covariance."""
    z_hit: float = 1.0
    """Weight of a correct fix, >= 0 [1]."""
    z_rand: float = 0.0
    """Weight of an outlier, uniform in ``region``, >= 0 [1]."""
    region: tuple[float, float, float, float] | None = None
    """Rectangle of outliers (x_min, y_min, x_max, y_max) in the world [m]; required if z_rand > 0."""
    mount: tuple[float, float] = (0.0, 0.0)
    """Antenna's position (x, y) on the robot [m]."""

    def __post_init__(self) -> None:
        if self.sigma is not None:
            self._check("sigma", above=0)
        if self.covariance is not None:
            if self.sigma is not None:
                raise ValueError(f"covariance: must be None where sigma is given, got {checks.show(self.covariance)}")
            object.__setattr__(self, "covariance", check_covariance("covariance", self.covariance))
        self._check_weights("z_hit", "z_rand")
        if self.region is not None:
            x, y, far_x, far_y = (float(value) for value in checks.array("region", self.region, (4,)))
            if not (x < far_x and y < far_y and 0 < (far_x - x) * (far_y - y) < math.inf):
                rule = "must be (x_min, y_min, x_max, y_max) with x_min < x_max and y_min < y_max, of a finite area > 0"
                raise ValueError(f"region: {rule}, got {checks.show(self.region)}")
            object.__setattr__(self, "region", (x, y, far_x, far_y))
        elif self.z_rand > 0:
            raise ValueError(f"region: must be given where z_rand > 0, got None with z_rand = {self.z_rand}")
        _check_mount(self, self.mount)


@dataclass(frozen=True)
class HeadingParameters(_Parameters):
    """Parameters of heading readings, for example from a compass.

    Raises:
        TypeError: A value has the wrong type for its field.
        ValueError: A value breaks its field's rule, or the weights do not sum to 1 within 1e-6.

    Example:
        >>> import gpusense as gs
        >>> gs.HeadingParameters(kind="von_mises", kappa=50.0).kappa
        50.0
    """

    sigma: float = 0.1
    """Standard deviation before wrapping, > 0 [rad]; used by ``"wrapped_normal"``."""
    kappa: float = 100.0
    """Concentration, >= 0 [1]; used by ``"von_mises"``; a large one is nearly a normal with sigma 1 / sqrt(kappa)."""
    kind: Literal["wrapped_normal", "von_mises"] = "wrapped_normal"
    """Distribution of correct readings around the true heading."""
    z_hit: float = 1.0
    """Weight of a correct reading, >= 0 [1]."""
    z_rand: float = 0.0
    """Weight of a random reading, uniform over the circle, >= 0 [1]."""
    offset: float = 0.0
    """Reading at a robot heading of 0: the mount's yaw less the magnetic declination [rad]."""

    def __post_init__(self) -> None:
        self._check("sigma", above=0)
        self._check("kappa", low=0)
        checks.choice("kind", self.kind, ("wrapped_normal", "von_mises"))
        self._check_weights("z_hit", "z_rand")
        self._check("offset")


@dataclass(frozen=True)
class BeaconParameters(_Parameters):
    """Parameters of ranges to beacons, for example ultra-wideband radios.

    Raises:
        TypeError: A value has the wrong type for its field.
        ValueError: A value breaks its field's rule, or the weights do not sum to 1 within 1e-6.

    Example:
        >>> import gpusense as gs
        >>> gs.BeaconParameters(sigma_range=0.1, kind="student_t", nu=3).nu
        3
    """

    sigma_range: float = 0.3
    """Standard deviation of a correct range, or a Student t's scale, > 0 [m]."""
    bias: float | tuple[float, ...] = 0.0
    """Mean error of ranges, common or per beacon; positive for ranges that are too long [m]."""
    kind: Literal["normal", "student_t", "mixture"] = "normal"
    """Distribution of correct ranges: a normal, Student's t, or a mixture of a normal and a wide normal."""
    nu: int = 4
    """Degrees of freedom of ``"student_t"``, 1 to 100 [1]."""
    heavy_weight: float = 0.1
    """Share of the wide normal of ``"mixture"``, 0 to 1 [1]."""
    sigma_heavy: float = 1.5
    """Standard deviation of the wide normal of ``"mixture"``, > 0 [m]."""
    z_hit: float = 0.95
    """Weight of a correct range, >= 0 [1]."""
    z_rand: float = 0.05
    """Weight of a random range, uniform up to range_max, >= 0 [1]."""
    range_max: float = 100.0
    """Longest range that the radio can report, > 0 [m]."""
    mount: tuple[float, float] = (0.0, 0.0)
    """Antenna's position (x, y) on the robot [m]."""

    def __post_init__(self) -> None:
        for name in ("sigma_range", "sigma_heavy", "range_max"):
            self._check(name, above=0)
        if isinstance(self.bias, (list, tuple, np.ndarray)):
            each = checks.array("bias", self.bias, ("M",))
            object.__setattr__(self, "bias", tuple(float(value) for value in each))
        else:
            self._check("bias")
        checks.choice("kind", self.kind, ("normal", "student_t", "mixture"))
        object.__setattr__(self, "nu", checks.integer("nu", self.nu, low=1, high=MOST_DEGREES))
        self._check("heavy_weight", low=0, high=1)
        self._check_weights("z_hit", "z_rand")
        _check_mount(self, self.mount)


@dataclass(frozen=True)
class BumperParameters(_Parameters):
    """Parameters of a bumper.

    Raises:
        TypeError: A value is not a real number.
        ValueError: A value breaks its field's rule.

    Example:
        >>> import gpusense as gs
        >>> gs.BumperParameters(p_contact=0.9).to_dict()
        {'p_contact': 0.9, 'p_false': 0.01, 'sigma': 0.05}
    """

    p_contact: float = 0.95
    """Probability that a bumper in contact with an obstacle is pressed, 0 to 1 [1]."""
    p_false: float = 0.01
    """Probability that a bumper without contact is pressed, 0 to 1 [1]."""
    sigma: float = 0.05
    """Joint standard deviation of outline and map, > 0 [m]."""

    def __post_init__(self) -> None:
        self._check("p_contact", low=0, high=1)
        self._check("p_false", low=0, high=1)
        self._check("sigma", above=0)


@dataclass(frozen=True)
class LineParameters(_Parameters):
    """Parameters of the line model. Deviations are noise of map and model; features may add their covariance.

    Raises:
        TypeError: A value is not a real number.
        ValueError: A value breaks its field's rule, or the two weights do not sum to 1 within 1e-6.

    Example:
        >>> import gpusense as gs
        >>> gs.LineParameters(sigma_distance=0.1).sigma_angle
        0.02
    """

    sigma_angle: float = 0.02
    """Standard deviation of a line's angle, in (0, 0.349] [rad]."""
    sigma_distance: float = 0.05
    """Standard deviation across the line, at the middle of its visible part, > 0 [m]."""
    z_detect: float = 0.9
    """Weight of a feature that comes from a line of the map, >= 0 [1]."""
    z_false: float = 0.1
    """Weight of a false positive, >= 0 [1]."""
    range_max: float = 20.0
    """Largest distance of a line from the sensor, > 0 [m]."""
    p_detect: float = 0.9
    """Probability of detecting a line in view, in [0, 1] [1]; used for drawn features only."""

    def __post_init__(self) -> None:
        self._check("sigma_angle", above=0, high=LARGEST_ANGLE_DEVIATION)
        self._check("sigma_distance", above=0)
        self._check_weights("z_detect", "z_false")
        self._check("range_max", above=0)
        self._check("p_detect", low=0, high=1)


class SensorTable(ABC):
    """A table of a sensor for ``BeamModel``: one look-up per beam, max readings included."""

    range_max: float
    """Readings of at least ``range_max`` are "no return", > 0 [m]."""
    bins: int
    """Number of range bins; one more bin is for "no return"."""

    @abstractmethod
    def sensor_table(self, dtype: DTypeLike) -> NDArray[Any]:
        """Return the (bins + 1, bins + 1) table of log densities by bin of the reading, then of the expected range.

        The last row, "no return", holds log probabilities.
        """

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """Return the table's parameters as plain numbers and strings."""
