"""Describe the geometry of a range scanner, and classify its readings."""

from __future__ import annotations

import enum
import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util import checks
from gpusense.world import plausible
from gpusense.world.messages import laser_geometry


class Reading(enum.IntEnum):
    """The class of a reading, as :func:`classify` returns it.

    Example:
        >>> import gpusense as gs
        >>> gs.Reading(1)
        <Reading.MAX: 1>
    """

    MISSING = 0
    """No information: the beam is ignored."""
    MAX = 1
    """No return within the scanner's range (REP-117)."""
    HIT = 2
    """A range [m]."""


class Scanner:
    """Immutable geometry of a planar range scanner; compared and hashed by value.

    A sonar is a scanner with cones as beams: its expected range is the nearest return among ``cone_rays`` rays, evenly
    spaced over the cone's width, edges included. Smooth walls are mirrors to sound: with ``critical_incidence``, a ray
    at a larger angle of incidence (see ``RayCaster.incidence``) does not return. Only beam models use cones; a
    likelihood field scores the end point on the cone's axis.

    Args:
        bearings: (K,) beam directions in the scanner's frame, counter-clockwise from its x axis [rad]; K may be 0.
            Copied.
        range_max: Readings of at least ``range_max`` are "no return" [m], > 0.
        range_min: Readings below ``range_min`` carry no information [m], at least 0 and less than ``range_max``. If
            ``range_min`` > 0, a reading of 0 carries no information either.
        mount: Pose (x, y, theta) of the scanner in the robot's frame [m, m, rad].
        cone: Full width of each beam [rad], 0 (a laser) to 2 pi.
        cone_rays: Rays per cone, 1 (its axis) to 1024; a laser has one.
        critical_incidence: Largest angle of incidence with a return [rad], above 0 and at most pi / 2; None for all.

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: A shape or a value breaks a rule above.

    Warns:
        PlausibilityWarning: Bearings or lengths seem to be in degrees or millimetres.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> gs.Scanner(np.linspace(-np.pi / 2, np.pi / 2, 181), range_max=8.0)
        Scanner(181 beams over 180 deg, range_max=8.0, range_min=0.0, mount=(0.0, 0.0, 0.0))
        >>> sonars = gs.Scanner(np.radians([-90, -30, 30, 90]), range_max=4.0, cone=0.26)
        >>> sonars.ray_bearings.shape
        (4, 9)
    """

    __slots__ = (
        "_bearings", "_cone", "_cone_rays", "_critical", "_first_scans", "_hash", "_mount", "_range_max", "_range_min",
    )  # fmt: skip

    def __init__(
        self,
        bearings: ArrayLike,
        range_max: float,
        range_min: float = 0.0,
        mount: ArrayLike = (0.0, 0.0, 0.0),
        *,
        cone: float = 0.0,
        cone_rays: int = 9,
        critical_incidence: float | None = None,
    ) -> None:
        directions: NDArray[np.float64] = np.array(checks.array("bearings", bearings, ("K",)))
        directions.setflags(write=False)
        self._bearings = directions
        self._range_max = checks.real("range_max", range_max, above=0)
        self._range_min = checks.real("range_min", range_min, low=0)
        if self._range_min >= self._range_max:
            raise ValueError(f"range_min: must be < range_max = {self._range_max}, got {self._range_min}")
        x, y, theta = checks.array("mount", mount, (3,)).tolist()
        self._mount: tuple[float, float, float] = (x, y, theta)
        self._cone = checks.real("cone", cone, low=0, high=2 * math.pi)
        rays = checks.integer("cone_rays", cone_rays, low=1, high=1024)
        self._cone_rays = rays if self._cone > 0 else 1
        self._critical = critical_incidence
        if critical_incidence is not None:
            self._critical = checks.real("critical_incidence", critical_incidence, above=0, high=math.pi / 2)
        self._first_scans = plausible.FirstScans(self._range_max, self._range_min)
        plausible.look_at_bearings("bearings", directions)
        plausible.look_at_scanner(self._range_max, self._mount)
        # Adding 0.0 maps -0.0 to 0.0, so that equal scanners hash alike.
        self._hash = hash(((directions + 0.0).tobytes(), *self._scalars()))

    @classmethod
    def uniform(
        cls,
        *,
        angle_min: float,
        angle_increment: float,
        count: int,
        range_max: float,
        range_min: float = 0.0,
        mount: ArrayLike = (0.0, 0.0, 0.0),
        cone: float = 0.0,
        cone_rays: int = 9,
        critical_incidence: float | None = None,
    ) -> Scanner:
        """Make a scanner with evenly spaced beams, as in ``sensor_msgs/LaserScan``.

        Args:
            angle_min: Bearing of beam 0 [rad].
            angle_increment: Step between beams, positive counter-clockwise [rad]; beam k has the bearing
                ``angle_min + k * angle_increment``.
            count: Number of beams K, 0 to 2^31 - 1.
            range_max: See :class:`Scanner` [m].
            range_min: See :class:`Scanner` [m].
            mount: See :class:`Scanner` [m, m, rad].
            cone: See :class:`Scanner` [rad].
            cone_rays: See :class:`Scanner`.
            critical_incidence: See :class:`Scanner` [rad].

        Raises:
            TypeError: An argument has the wrong type.
            ValueError: A value breaks a rule above.
        """
        first = checks.real("angle_min", angle_min)
        step = checks.real("angle_increment", angle_increment)
        beams = checks.integer("count", count, low=0, high=2**31 - 1)
        if not math.isfinite(first + step * beams):
            raise ValueError(f"angle_increment: must keep every bearing finite, got {step}")
        return cls(
            first + step * np.arange(beams), range_max, range_min, mount, cone=cone, cone_rays=cone_rays,
            critical_incidence=critical_incidence,
        )  # fmt: skip

    @classmethod
    def from_laser_scan(
        cls,
        message: Any,
        mount: ArrayLike = (0.0, 0.0, 0.0),
        *,
        range_max: float | None = None,
        range_min: float | None = None,
    ) -> Scanner:
        """Make a scanner from a ``sensor_msgs/LaserScan``, without ROS.

        Beam k has the bearing ``angle_min + k angle_increment``. Each of ``ranges`` has a beam, even if the last beam
        repeats the first one's direction, so that ``message.ranges`` are readings of this scanner. REP-117's
        infinities and NaN are classified by :func:`classify`.

        Args:
            message: Any object or mapping with the fields angle_min, angle_increment, range_min, range_max and ranges
                of the message. ``angle_max`` follows from these and is not read.
            mount: Pose (x, y, theta) of the laser in the robot's frame [m, m, rad].
            range_max: Replaces the message's ``range_max`` [m], for drivers that state infinity, NaN or 0.
            range_min: Replaces the message's ``range_min`` [m].

        Raises:
            TypeError: A field is absent or has the wrong type.
            ValueError: A value is not finite or breaks a rule of :class:`Scanner`, or beams coincide.

        Example:
            >>> import gpusense as gs
            >>> message = dict(angle_min=-1.5, angle_increment=0.5, range_min=0.1, range_max=8.0, ranges=[2.0] * 7)
            >>> gs.Scanner.from_laser_scan(message, mount=(0.2, 0.0, 0.0))
            Scanner(7 beams over 171.9 deg, range_max=8.0, range_min=0.1, mount=(0.2, 0.0, 0.0))
        """
        return cls.uniform(**laser_geometry(message, range_max, range_min), mount=mount)

    @property
    def bearings(self) -> NDArray[np.float64]:
        """(K,) beam directions in the scanner's frame [rad]; read-only."""
        return self._bearings

    @property
    def count(self) -> int:
        """Number of beams K."""
        return self._bearings.size

    @property
    def range_max(self) -> float:
        """Upper limit of ranges [m]; readings of at least ``range_max`` are "no return"."""
        return self._range_max

    @property
    def range_min(self) -> float:
        """Lower limit of ranges [m]; readings below it carry no information."""
        return self._range_min

    @property
    def mount(self) -> tuple[float, float, float]:
        """Pose (x, y, theta) of the scanner in the robot's frame [m, m, rad]."""
        return self._mount

    @property
    def cone(self) -> float:
        """Full width of each beam [rad]; 0 for a laser."""
        return self._cone

    @property
    def cone_rays(self) -> int:
        """Rays per beam; 1 for a laser."""
        return self._cone_rays

    @property
    def critical_incidence(self) -> float | None:
        """Largest angle of incidence with a return [rad]; None for all."""
        return self._critical

    @property
    def ray_bearings(self) -> NDArray[np.float64]:
        """(K, cone_rays) directions of the rays of each beam in the scanner's frame [rad]; a single ray is the axis."""
        between = self._cone / max(self._cone_rays - 1, 1)
        return self._bearings[:, None] + (np.arange(self._cone_rays) - (self._cone_rays - 1) / 2) * between

    def _scalars(self) -> tuple[Any, ...]:
        return self._range_max, self._range_min, self._mount, self._cone, self._cone_rays, self._critical

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Scanner):
            return NotImplemented
        return self._scalars() == other._scalars() and np.array_equal(self._bearings, other._bearings)

    def __hash__(self) -> int:
        return self._hash

    def __repr__(self) -> str:
        sonar = f", cone={self._cone}, cone_rays={self._cone_rays}" if self._cone > 0 else ""
        sonar += "" if self._critical is None else f", critical_incidence={self._critical}"
        span = math.degrees(np.ptp(self._bearings)) if self.count else 0.0
        return (
            f"Scanner({self.count} beams over {span:.4g} deg, range_max={self._range_max}, "
            f"range_min={self._range_min}, mount={self._mount}{sonar})"
        )

    def __reduce__(self) -> tuple[Callable[..., Scanner], tuple[Any, ...]]:
        # Copies and pickles call the constructor, which makes their bearings read-only.
        sonar = functools.partial(
            Scanner, cone=self._cone, cone_rays=self._cone_rays, critical_incidence=self._critical
        )
        return sonar, (self._bearings, self._range_max, self._range_min, self._mount)


def classify(ranges: ArrayLike, scanner: Scanner) -> NDArray[np.uint8]:
    """Classify every reading of a scan, or of several scans, as a :class:`Reading`.

    ======================================================  ===========
    reading z                                               class
    ======================================================  ===========
    NaN, -inf, z < 0, z < range_min (0 if range_min > 0)    ``MISSING``
    +inf, z >= range_max                                    ``MAX``
    else                                                    ``HIT``
    ======================================================  ===========

    The limits are rounded to the floating dtype of the readings before comparison, so that a ``range_max`` stored as
    float32 is recognised. Integers become float64. Source: REP-117 and the message definition of
    ``sensor_msgs/LaserScan``.

    Args:
        ranges: (K,) or (S, K) readings of any value [m].
        scanner: The scanner of these readings.

    Returns:
        uint8 of the same shape.

    Raises:
        TypeError: ``ranges`` does not hold real numbers, or ``scanner`` is not a :class:`Scanner`.
        ValueError: The shape is neither (K,) nor (S, K).

    Example:
        >>> import gpusense as gs
        >>> scanner = gs.Scanner([-0.5, 0.0, 0.5], range_max=8.0, range_min=0.1)
        >>> gs.classify([2.5, 8.0, float("nan")], scanner).tolist()
        [2, 1, 0]
    """
    checks.instance("scanner", scanner, Scanner)
    z = checks.array("ranges", ranges, finite=False, dtype=None)
    if z.ndim not in (1, 2) or z.shape[-1] != scanner.count:
        rule = f"shape must be ({scanner.count},) or (S, {scanner.count})"
        raise ValueError(f"ranges: {rule}, got {checks.shape_text(z.shape)}")
    return reading_classes(z, scanner.range_min, scanner.range_max)


def classify_ranges(
    z: NDArray[np.floating], range_min: float, range_max: float
) -> tuple[NDArray[np.bool], NDArray[np.bool]]:
    """Return the masks of hits and of max readings, of any shape; all other readings are missing.

    Kernels have the same rule in the file ``reading_class``; calling it would take longer than these comparisons.
    """
    nearest, farthest = range_limits(z.dtype, range_min, range_max)
    return (z >= nearest) & (z < farthest), z >= farthest


def reading_classes(z: NDArray[np.floating], range_min: float, range_max: float) -> NDArray[np.uint8]:
    """Return the class of each reading of any shape, as :func:`classify` does."""
    hit, far = classify_ranges(z, range_min, range_max)
    kinds: NDArray[np.uint8] = np.full(z.shape, Reading.MISSING, np.uint8)
    kinds[hit], kinds[far] = Reading.HIT, Reading.MAX
    return kinds


def float64_readings(z: NDArray[Any], scanner: Scanner) -> NDArray[np.float64]:
    """Convert readings to float64 and keep their classes, although limits are rounded to the original type."""
    if z.dtype.kind != "f" or z.dtype == np.float64:
        return z.astype(np.float64, copy=False)
    hit, far = classify_ranges(z, scanner.range_min, scanner.range_max)
    return np.where(hit, np.maximum(z.astype(np.float64), scanner.range_min), np.where(far, np.inf, np.nan))


@functools.lru_cache(maxsize=64)
def range_limits(dtype: np.dtype, range_min: float, range_max: float) -> tuple[float, float]:
    """Return the least hit and the least max reading, rounded to the type of the readings.

    A reading of 0 is missing if range_min > 0, even where range_min is rounded to 0.
    """
    with np.errstate(over="ignore"):  # range_max may exceed float16
        nearest, farthest = float(dtype.type(range_min)), float(dtype.type(range_max))
    if nearest == 0 < range_min:
        nearest = float(np.finfo(dtype).smallest_subnormal)
    return nearest, max(nearest, farthest)
