"""Warn of legal but implausible values: degrees for radians, millimetres for metres, places off the map.

Values are used unchanged. A warning names the likely cause, once. Geometry is checked at construction, and readings in
a scanner's first scans.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util.notices import warn_user

# A heading or bearing beyond a turn, with a margin for float32 rounding [rad].
_TURN = 2 * math.pi * (1 + 1e-6)
# Headings in degrees are at most two turns.
_DEGREES = 720.0
# Larger cells suggest that a map is in other units [m].
_LARGEST_CELL = 1.0
# Range beyond any robot's scanner, and range that is doubtful in a much smaller map [m].
_FARTHEST, _FAR = 1e4, 1e3
# Largest distance of a scanner from the robot's centre [m].
_LARGEST_MOUNT = 100.0
# Number of calls to check for each scanner.
_CALLS = 32
# Readings beyond these multiples of range_max or of the map's size are in other units; a single value may be a code
# for "no return".
_TIMES_RANGE, _TIMES_MAP, _VALUES = 10.0, 100.0, 3
# Share of readings of exactly 0 beyond which 0 is probably a code.
_ZEROS = 0.1
_IN_DEGREES = "are they in degrees? Radians are meant (numpy.radians converts)"


class PlausibilityWarning(UserWarning):
    """A value is legal, but probably in wrong units or in a wrong frame; it is used unchanged.

    ``warnings.simplefilter("error", gs.PlausibilityWarning)`` makes it an error, ``"ignore"`` silences it.

    Example:
        >>> import gpusense as gs, warnings
        >>> with warnings.catch_warnings(record=True) as caught:
        ...     warnings.simplefilter("always")
        ...     scanner = gs.Scanner([-90.0, 0.0, 90.0], range_max=8.0)
        >>> print(caught[0].message)
        bearings: span 180 rad, more than a turn: are they in degrees? Radians are meant (numpy.radians converts)
    """


def _notice(text: str) -> None:
    warn_user(text, PlausibilityWarning)


def look_at_bearings(name: str, bearings: NDArray[np.float64]) -> None:
    """Warn of bearings that span more than a turn, or exceed two turns [rad]."""
    if not bearings.size:
        return
    low, high = float(bearings.min()), float(bearings.max())
    if high - low > _TURN * (1 + 1 / bearings.size):
        _notice(f"{name}: span {high - low:.4g} rad, more than a turn: {_IN_DEGREES}")
    elif max(-low, high) > 2 * _TURN:
        _notice(f"{name}: reach {max(-low, high):.4g} rad, more than two turns from 0: {_IN_DEGREES}")


def look_at_heading(name: str, heading: float) -> None:
    """Warn of a heading of more than a turn [rad]."""
    if abs(heading) > _TURN:
        _notice(
            f"{name}: has a heading of {heading:.6g} rad, more than a turn: is it in degrees? Radians are meant "
            "(math.radians converts)"
        )


def look_at_poses(name: str, poses: ArrayLike) -> None:
    """Warn of headings that spread like degrees: over more than four turns, and none beyond 720."""
    try:
        headings = np.asarray(poses)[..., 2]
    except (IndexError, ValueError):  # of another shape, which the models refuse
        return
    if not headings.size or headings.dtype.kind not in "fiu":
        return
    low, high = float(headings.min()), float(headings.max())
    if high - low > 4 * _TURN and max(-low, high) <= _DEGREES:
        _notice(f"{name}: have headings over more than four turns: {_IN_DEGREES}")


def look_at_scanner(range_max: float, mount: tuple[float, float, float]) -> None:
    """Warn of an implausible range or mount of a scanner."""
    if range_max > _FARTHEST:
        _notice(f"range_max: is {range_max:.6g} m, farther than a range scanner sees: is it in millimetres?")
    if math.hypot(*mount[:2]) > _LARGEST_MOUNT:
        _notice(f"mount: is {math.hypot(*mount[:2]):.6g} m from the robot's centre: is it in millimetres?")
    look_at_heading("mount", mount[2])


def look_at_grid(resolution: float, origin: tuple[float, float, float]) -> None:
    """Warn of implausibly large cells, and of an origin in degrees."""
    if resolution > _LARGEST_CELL:
        _notice(
            f"resolution: is {resolution:.6g} m, the side of a cell: is it in centimetres or millimetres? Maps for "
            "robots have cells of 0.01 to 0.25 m"
        )
    look_at_heading("origin", origin[2])


def look_at_scene(range_max: float, size: float) -> None:
    """Warn of a range far larger than the map.

    ``range_max``: largest range [m]; ``size``: diagonal of the map [m].
    """
    if _FAR < range_max <= _FARTHEST and range_max > 10 * size:
        _notice(
            f"range_max: is {range_max:.6g} m in a map of {size:.4g} m from corner to corner: is it in millimetres, or "
            "the map's resolution in other units than metres?"
        )


def look_at_readings(
    name: str, ranges: NDArray[np.floating], range_max: float, size: float | None = None, range_min: float = 0.0
) -> bool:
    """Warn of negative readings, of many readings of exactly 0 m, and of readings in other units than metres.

    ``ranges``: readings of one scan or several scans [m]; ``range_max``: longest range of the scanner [m]; ``size``:
    diagonal of the map [m]; None without a map; ``range_min``: shortest range of the scanner [m]; above 0, readings of
    0 are missing.

    Returns:
        Whether a reading was implausible.
    """
    finite = ranges[np.isfinite(ranges)]
    doubtful = False
    if (finite < 0).any():
        doubtful = True
        _notice(
            f"{name}: negative readings are missing readings, which say nothing (0 nats): a scanner's code for an "
            "error, or another sign than meant? NaN is a missing reading without this warning"
        )
    zeros = 0 if range_min > 0 else int(np.count_nonzero(finite == 0))
    if zeros >= _VALUES and zeros > _ZEROS * ranges.size:
        doubtful = True
        _notice(
            f"{name}: {zeros} of {ranges.size} readings are exactly 0, a range of 0 m: a scanner's code for no return "
            "or an error? A range_min > 0 or NaN makes them missing readings, range_max makes them no return"
        )
    positive = finite[finite > 0]
    if len(positive):
        limits = {f"range_max = {range_max:.6g} m": _TIMES_RANGE * range_max}
        limits |= {} if size is None else {f"the map, {size:.4g} m from corner to corner": _TIMES_MAP * size}
        for what, limit in limits.items():
            beyond = positive[positive > limit]
            if 2 * len(beyond) > len(positive) and len(np.unique(beyond)) >= _VALUES:
                _notice(f"{name}: most readings are far beyond {what}: are they in millimetres? Metres are meant")
                return True
    return doubtful


class FirstScans:
    """Check of a scanner's first scans until one is doubtful; later scans cost nothing.

    ``range_max``: longest range of the scanner [m]; ``range_min``: shortest range of the scanner [m].

    Attributes:
        left: Number of further calls to check.
    """

    __slots__ = ("_range_max", "_range_min", "left")

    def __init__(self, range_max: float, range_min: float) -> None:
        self._range_max, self._range_min, self.left = range_max, range_min, _CALLS

    def look_at(self, name: str, ranges: NDArray[np.floating], size: float | None = None) -> None:
        """Warn of implausible readings; arguments as for :func:`look_at_readings`."""
        if not self.left:
            return
        self.left -= 1
        least = np.fmin.reduce(ranges, axis=None, initial=np.inf)
        if 0 < least < self._range_max or (least == 0 and self._range_min > 0):
            return
        if look_at_readings(name, ranges, self._range_max, size, self._range_min):
            self.left = 0


def look_at_start(pose: NDArray[np.float64], inside: bool, bounds: tuple[float, float, float, float]) -> None:
    """Warn of a start off the map, or with a heading in degrees.

    ``pose``: (3,) start [m, m, rad]; ``inside``: true if the start is on the map; ``bounds``: (x_min, y_min, x_max,
    y_max) of the map [m].
    """
    x, y, theta = pose.tolist()
    if not inside:
        low_x, low_y, high_x, high_y = bounds
        _notice(
            f"start: ({x:.6g}, {y:.6g}) m lies outside the map, which has x from {low_x:.6g} to {high_x:.6g} m and y "
            f"from {low_y:.6g} to {high_y:.6g} m: is it in another frame, or in cells?"
        )
    look_at_heading("start", theta)
