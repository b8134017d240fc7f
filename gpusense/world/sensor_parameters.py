"""The intrinsic parameters of absolute, radio and contact sensors: frozen, validated dataclasses."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Literal

import numpy as np

from gpusense._util import checks
from gpusense.world.parameters import _Parameters

# Up to this many degrees of freedom a t's mass is a short sum; with more it is a normal for all practical purposes.
MOST_DEGREES = 100


def check_covariance(name: str, value: object) -> tuple[tuple[float, float], tuple[float, float]]:
    """A symmetric positive definite 2 x 2 matrix.

    Raises:
        TypeError: not numbers.
        ValueError: another shape, not finite, not symmetric, or not positive definite.
    """
    c = checks.array(name, value, (2, 2))
    if abs(c[0, 1] - c[1, 0]) > 1e-9 * np.sqrt(abs(c[0, 0] * c[1, 1])):
        raise ValueError(f"{name}: must be symmetric, got {checks.show(c.tolist())}")
    xx, yy, off = float(c[0, 0]), float(c[1, 1]), float(c[0, 1] / 2 + c[1, 0] / 2)
    # Exactly, since what follows takes the root of the difference.
    if not (xx > 0 and yy > 0 and Fraction(off) ** 2 < Fraction(xx) * Fraction(yy)):
        raise ValueError(f"{name}: must be positive definite, got {checks.show(c.tolist())}")
    return (xx, off), (off, yy)


def _check_mount(parameters: object, value: object) -> None:
    x, y = checks.array("mount", value, (2,))
    object.__setattr__(parameters, "mount", (float(x), float(y)))


@dataclass(frozen=True)
class PositionParameters(_Parameters):
    """Parameters of a position fix, such as that of a satellite receiver.

    Raises:
        TypeError: a value is not of its field's kind.
        ValueError: a value breaks its field's rule, both or neither of sigma and covariance make sense, or the weights
            do not sum to 1 within 1e-6.
    """

    sigma: float | None = None
    """The standard deviation along x and along y, > 0 [m]."""
    covariance: tuple[tuple[float, float], tuple[float, float]] | None = None
    """Instead of sigma: the covariance matrix in the world [m^2]. Without either, every measurement has its own."""
    z_hit: float = 1.0
    """The weight of a correct fix, >= 0 [1]."""
    z_rand: float = 0.0
    """The weight of an outlier, which is anywhere in the region, >= 0 [1]."""
    region: tuple[float, float, float, float] | None = None
    """Where outliers are: (x_min, y_min, x_max, y_max) in the world [m]; needed where z_rand > 0."""
    mount: tuple[float, float] = (0.0, 0.0)
    """Where the antenna is on the robot (x, y) [m]."""

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
            if not (x < far_x and y < far_y):
                rule = "must be (x_min, y_min, x_max, y_max) with x_min < x_max and y_min < y_max"
                raise ValueError(f"region: {rule}, got {checks.show(self.region)}")
            object.__setattr__(self, "region", (x, y, far_x, far_y))
        elif self.z_rand > 0:
            raise ValueError(f"region: must be given where z_rand > 0, got None with z_rand = {self.z_rand}")
        _check_mount(self, self.mount)


@dataclass(frozen=True)
class HeadingParameters(_Parameters):
    """Parameters of a heading, such as that of a compass.

    Raises:
        TypeError: a value is not of its field's kind.
        ValueError: a value breaks its field's rule, or the weights do not sum to 1 within 1e-6.
    """

    sigma: float = 0.1
    """The standard deviation before wrapping, > 0 [rad]; used by ``"wrapped_normal"``."""
    kappa: float = 100.0
    """The concentration, >= 0 [1]; used by ``"von_mises"``; a large one is as a normal with 1 / sqrt(kappa)."""
    kind: Literal["wrapped_normal", "von_mises"] = "wrapped_normal"
    """How correct readings are distributed around the truth."""
    z_hit: float = 1.0
    """The weight of a correct reading, >= 0 [1]."""
    z_rand: float = 0.0
    """The weight of a reading that may be anything, >= 0 [1]."""
    offset: float = 0.0
    """What the sensor reads where the robot's heading is 0: its mount's yaw, less the magnetic declination [rad]."""

    def __post_init__(self) -> None:
        self._check("sigma", above=0)
        self._check("kappa", low=0)
        checks.choice("kind", self.kind, ("wrapped_normal", "von_mises"))
        self._check_weights("z_hit", "z_rand")
        self._check("offset")


@dataclass(frozen=True)
class BeaconParameters(_Parameters):
    """Parameters of ranges to beacons, such as ultra-wideband radios.

    Raises:
        TypeError: a value is not of its field's kind.
        ValueError: a value breaks its field's rule, or the weights do not sum to 1 within 1e-6.
    """

    sigma_range: float = 0.3
    """The standard deviation of a correct range, or a Student t's scale, > 0 [m]."""
    bias: float = 0.0
    """By how much ranges are too long [m]."""
    kind: Literal["normal", "student_t", "mixture"] = "normal"
    """How correct ranges are distributed: normal, Student's t, or one normal and a wide one."""
    nu: int = 4
    """The degrees of freedom of ``"student_t"``, 1 to 100 [1]."""
    heavy_weight: float = 0.1
    """The share of the wide normal of ``"mixture"``, 0 to 1 [1]."""
    sigma_heavy: float = 1.5
    """The standard deviation of the wide normal of ``"mixture"``, > 0 [m]."""
    z_hit: float = 0.95
    """The weight of a correct range, >= 0 [1]."""
    z_rand: float = 0.05
    """The weight of a range that may be anything up to range_max, >= 0 [1]."""
    range_max: float = 100.0
    """The longest range that the radio can report, > 0 [m]."""
    mount: tuple[float, float] = (0.0, 0.0)
    """Where the antenna is on the robot (x, y) [m]."""

    def __post_init__(self) -> None:
        for name in ("sigma_range", "sigma_heavy", "range_max"):
            self._check(name, above=0)
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
        TypeError: a value is not a real number.
        ValueError: a value breaks its field's rule.
    """

    p_contact: float = 0.95
    """The probability that a bumper which touches something is pressed, 0 to 1 [1]."""
    p_false: float = 0.01
    """The probability that a bumper which touches nothing is pressed, 0 to 1 [1]."""
    sigma: float = 0.05
    """The standard deviation of the outline and the map together, > 0 [m]."""

    def __post_init__(self) -> None:
        self._check("p_contact", low=0, high=1)
        self._check("p_false", low=0, high=1)
        self._check("sigma", above=0)
