"""Motion models: densities of a robot's motion for given odometry or commands.

The models follow Thrun, Burgard and Fox, *Probabilistic Robotics* (2005), chapter 5. Each returns means and deviations
of a first turn, a translation ahead and to the left, and a second turn; the kernel ``move_particles`` samples them for
each particle.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from gpusense._util import checks
from gpusense.interface.constants import STRAIGHT, VELOCITY_MODEL
from gpusense.localization.defaults import DEFAULTS
from gpusense.world.parameters import _Parameters

# Least translation that has a direction [m].
SHORTEST = 0.01
# Largest turn of a step and largest deviation of turns [rad]; kernels limit headings to LARGEST_HEADING.
_MOST_TURNED = 1e5
# Arguments of ``predict`` for models of odometry.
_ODOMETRY = "the odometry before and after the step"


class SampledMotion(NamedTuple):
    """Parameters of the kernel ``move_particles``."""

    # First turn, translation ahead and to the left, second turn [rad, m, m, rad].
    mean: tuple[float, float, float, float]
    deviation: tuple[float, float, float, float]  # their standard deviations
    kind: int = STRAIGHT  # straight translation or arc
    reverse: float = 0.0  # probability that the translation had the opposite direction

    def after(self, pose: Sequence[float]) -> tuple[float, float, float]:
        """Return a pose (x, y, theta) [m, m, rad] after the mean motion."""
        (x, y, theta), (first, ahead, left, second) = pose, self.mean
        if self.kind == VELOCITY_MODEL:
            # Chord of an arc that turns by twice the first turn.
            ahead, second = ahead * (math.sin(first) / first if first else 1.0), first + second
        cosine, sine = math.cos(theta + first), math.sin(theta + first)
        turned = math.remainder(theta + first + second, math.tau)
        return x + cosine * ahead - sine * left, y + sine * ahead + cosine * left, turned


# No motion.
STILL = SampledMotion((0.0,) * 4, (0.0,) * 4)


class MotionModel(Protocol):
    """Motion that a particle filter samples from the arguments of ``predict``."""

    def sampled(self, *arguments: Any) -> SampledMotion:
        """Return the numbers of one step."""


def _odometer(name: str, pose: Any) -> tuple[float, float, float]:
    """Return a checked pose of an odometer; the general check would take most of the time of a step's motion."""
    if type(pose) is np.ndarray and pose.shape == (3,) and pose.dtype == np.float64:
        values = pose.tolist()
    elif type(pose) in (tuple, list) and [type(one) for one in pose] == [float] * 3:
        values = pose
    else:
        values = checks.array(name, pose, (3,)).tolist()
    x, y, theta = values
    if not (abs(x) <= checks.FARTHEST and abs(y) <= checks.FARTHEST and abs(theta) <= checks.FARTHEST):
        checks.array(name, pose, (3,), largest=checks.FARTHEST)
    return x, y, theta


def _difference(before: Sequence[float], after: Sequence[float]) -> tuple[float, float, float]:
    """Return the pose ``after`` in the frame of ``before``, without the cost of arrays."""
    (x0, y0, theta0), (x1, y1, theta1) = before, after
    x, y, cosine, sine = x1 - x0, y1 - y0, math.cos(theta0), math.sin(theta0)
    return cosine * x + sine * y, cosine * y - sine * x, math.remainder(theta1 - theta0, math.tau)


def odometry_turns(before: object, after: object) -> tuple[float, float, float]:
    """Return an odometer's motion as a first turn, a translation and a second turn [rad, m, rad].

    For translations below 1 cm the second turn is the whole turn. A first turn of more than a quarter turn counts as
    driving backwards, with a negative translation.

    Args:
        before: (3,) pose in the frame of the odometer [m, m, rad].
        after: (3,) pose of the next reading.

    Raises:
        TypeError, ValueError: not poses.

    Example:
        >>> import gpusense as gs
        >>> gs.odometry_turns((0.0, 0.0, 0.0), (-1.0, 0.0, 0.0))
        (0.0, -1.0, 0.0)
    """
    return turns_between(_odometer("before", before), _odometer("after", after))


def turns_between(before: Sequence[float], after: Sequence[float]) -> tuple[float, float, float]:
    """Return the motion between checked poses of an odometer; see :func:`odometry_turns`."""
    x, y, turn = _difference(before, after)
    trans = math.hypot(x, y)
    first = math.atan2(y, x) if trans >= SHORTEST else 0.0
    if abs(first) > math.pi / 2:
        first, trans = first - math.copysign(math.pi, first), -trans
    return first, trans, math.remainder(turn - first, math.tau)


def _check_noise(model: OdometryMotion | OmniMotion | VelocityMotion, count: int) -> None:
    """Check the ``count`` numbers ``alpha`` of a model and its two least deviations, and make them tuples of floats."""
    for name, size in (("alpha", count), ("least", 2)):
        values = checks.array(name, getattr(model, name), (size,))
        if values.min() < 0:
            raise ValueError(f"{name}: must be >= 0, got {values.min()}")
        object.__setattr__(model, name, tuple(values.tolist()))


def _two_of(arguments: tuple[Any, ...], what: str) -> tuple[Any, Any]:
    """Return the two arguments of ``predict``."""
    if len(arguments) != 2:
        raise TypeError(f"predict: must have {what}, got {len(arguments)} values")
    return arguments


@dataclasses.dataclass(frozen=True)
class OdometryMotion(_Parameters):
    """Odometry motion model, *Probabilistic Robotics* table 5.6.

    Attributes:
        alpha: (4,) noise. The variances are ``alpha[0] turn^2 + alpha[1] trans^2`` of each turn, and
            ``alpha[2] trans^2 + alpha[3] (turn1^2 + turn2^2)`` of the translation [rad^2, m^2].
        reverse: Probability of a translation in the opposite direction. Some odometers count wheel turns without sign;
            with 0, a filter loses track on their logs.
        least: Additional standard deviations of translation and turns of each step [m, rad], for slipping wheels or a
            pushed robot.
        systematic: Systematic errors, corrected before noise is added: the missed shares of translations and of turns,
            and a turn per metre [rad/m], as from wheels of unequal radius (Borenstein and Feng 1996).
        sideways: Variance of a sideways translation per squared turn [m^2/rad^2], for a robot that slips in turns, or
            an odometer at a point other than the centre of rotation. 0 is the book's model without sideways motion.

    Raises:
        TypeError, ValueError: a number is missing, negative or not finite.

    Example:
        >>> import gpusense as gs
        >>> gs.OdometryMotion(alpha=(0.1, 0.1, 0.05, 0.05)).sampled((0, 0, 0), (1, 0, 0)).mean
        (0.0, 1.0, 0.0, 0.0)
    """

    alpha: tuple[float, ...] = DEFAULTS.alpha
    reverse: float = DEFAULTS.reverse
    least: tuple[float, float] = DEFAULTS.least
    systematic: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sideways: float = DEFAULTS.sideways

    def __post_init__(self) -> None:
        _check_noise(self, 4)
        self._check("reverse", low=0, high=1)
        self._check("sideways", low=0)
        missed = checks.array("systematic", self.systematic, (3,))
        object.__setattr__(self, "systematic", tuple(missed.tolist()))

    def sampled(self, *arguments: Any) -> SampledMotion:
        """Return the numbers of a step from the odometer's poses before and after it."""
        return self.sampled_turns(*odometry_turns(*_two_of(arguments, _ODOMETRY)))

    def sampled_turns(self, first: float, trans: float, second: float) -> SampledMotion:
        """Return the numbers of a step from its motion; see :func:`odometry_turns`."""
        stretch, gain, drift = self.systematic
        half_drift = drift * trans / 2
        first, second = first * (1 + gain) + half_drift, second * (1 + gain) + half_drift
        trans *= 1 + stretch
        a1, a2, a3, a4 = self.alpha
        at, ar = self.least
        # Noise is independent of the direction: turning by half a turn and back is no turn.
        before = math.sqrt(a1 * first * first + a2 * trans * trans + ar * ar)
        after = math.sqrt(a1 * second * second + a2 * trans * trans + ar * ar)
        squares = first * first + second * second
        length = math.sqrt(a3 * trans * trans + a4 * squares + at * at)
        side = math.sqrt(self.sideways * squares + at * at) if self.sideways > 0 else 0.0
        reverse = self.reverse if abs(trans) >= SHORTEST else 0.0
        return SampledMotion((first, trans, 0.0, second), (before, length, side, after), STRAIGHT, reverse)


@dataclasses.dataclass(frozen=True)
class OmniMotion:
    """Motion of a robot that moves in any direction, from its odometry.

    Attributes:
        alpha: (5,) noise. The variances are ``alpha[0] turn^2 + alpha[1] trans^2`` of the turn, ``alpha[2] trans^2 +
            alpha[3] turn^2`` of the translation along its direction, and ``alpha[4] trans^2 + alpha[3] turn^2`` across.
        least: Additional standard deviations of translation and turn of each step [m, rad].

    Raises:
        TypeError, ValueError: a number is missing, negative or not finite.

    Example:
        >>> import gpusense as gs
        >>> gs.OmniMotion().sampled((0, 0, 0), (1, 0, 0)).mean
        (0.0, 1.0, 0.0, 0.0)
    """

    alpha: tuple[float, ...] = (0.02, 0.02, 0.02, 0.02, 0.02)
    least: tuple[float, float] = DEFAULTS.least

    def __post_init__(self) -> None:
        _check_noise(self, 5)

    def sampled(self, *arguments: Any) -> SampledMotion:
        """Return the numbers of a step from the odometer's poses before and after it."""
        before, after = _two_of(arguments, _ODOMETRY)
        x, y, turn = _difference(_odometer("before", before), _odometer("after", after))
        trans = math.hypot(x, y)
        direction = math.atan2(y, x) if trans > 0 else 0.0
        a1, a2, a3, a4, a5 = self.alpha
        at, ar = (value * value for value in self.least)
        along = math.sqrt(a3 * trans * trans + a4 * turn * turn + at)
        across = math.sqrt(a5 * trans * trans + a4 * turn * turn + at)
        turning = math.sqrt(a1 * turn * turn + a2 * trans * trans + ar)
        return SampledMotion((direction, trans, 0.0, turn - direction), (0.0, along, across, turning))


@dataclasses.dataclass(frozen=True)
class VelocityMotion:
    """Velocity motion model, *Probabilistic Robotics* table 5.3: an arc at commanded velocities.

    ``predict`` takes the velocities (v, w) [m/s, rad/s] and the duration [s].

    Attributes:
        alpha: (6,) noise. The variances are ``alpha[0] v^2 + alpha[1] w^2`` of v, ``alpha[2] v^2 + alpha[3] w^2`` of w
            and ``alpha[4] v^2 + alpha[5] w^2`` of a last turn per second.
        least: Additional standard deviations of translation and last turn of each step [m, rad].

    Raises:
        TypeError, ValueError: a number is missing, negative or not finite.

    Example:
        >>> import gpusense as gs
        >>> gs.VelocityMotion().sampled((1.0, 0.5), 0.1).mean
        (0.025, 0.1, 0.0, 0.0)
    """

    alpha: tuple[float, ...] = (0.02, 0.02, 0.02, 0.02, 0.01, 0.01)
    least: tuple[float, float] = DEFAULTS.least

    def __post_init__(self) -> None:
        _check_noise(self, 6)

    def sampled(self, *arguments: Any) -> SampledMotion:
        """Return the numbers of a step from velocities and a duration."""
        velocity, duration = _two_of(arguments, "velocities and a duration")
        v, w = checks.array("velocity", velocity, (2,), largest=checks.FARTHEST).tolist()
        seconds = checks.real("seconds", duration, low=0, high=checks.FARTHEST)
        if abs(w * seconds) > _MOST_TURNED:
            raise ValueError(f"velocity: must turn by at most {_MOST_TURNED:g} rad in a step, got {w * seconds}")
        a1, a2, a3, a4, a5, a6 = self.alpha
        at, ar = self.least
        length = math.hypot(math.sqrt(a1 * v * v + a2 * w * w) * seconds, at)
        half = math.sqrt(a3 * v * v + a4 * w * w) * seconds / 2
        last = math.hypot(math.sqrt(a5 * v * v + a6 * w * w) * seconds, ar)
        # The last turn removes whole turns.
        back = math.tau * -round(w * seconds / math.tau)
        return SampledMotion((w * seconds / 2, v * seconds, 0.0, back), (half, length, 0.0, last), VELOCITY_MODEL)


def settings_of(motion: SampledMotion) -> tuple[list[float], float]:
    """Return the eight means and deviations, and the probability of a reverse."""
    first, ahead, left, second = motion.deviation
    # A heading with a deviation of many turns is uniform; the limit changes only the size of the numbers.
    turns = min(first, _MOST_TURNED), min(second, _MOST_TURNED)
    return [*motion.mean, turns[0], ahead, left, turns[1]], motion.reverse
