"""Choose common beams for the scans of a bag's laser, and map readings of other scans to them."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense._util.notices import warn_user
from gpusense._util.typing import Floats
from gpusense.logs.records import Pose
from gpusense.world.messages import distinct_beams, laser_beams, nearest_beams, real_field
from gpusense.world.messages import field as field_of
from gpusense.world.scanner import Scanner

Angles = tuple[float, float, int]
"""angle_min, angle_increment, and number of beams."""
Geometry = tuple[Angles, float, float]
"""Stated angles, range_min and range_max."""
# Number of common beams where beams vary, and its largest multiple for lasers with finer steps.
_PLACES, _FINER = 1440, 16
# Equal angles differ by less than this share of a step.
_SAME = 0.05
# Number of frequent angles that are candidates for the common beams.
_CANDIDATES = 10
# Longest plausible time of a scan [s].
_LONGEST = 2.0


def geometry_of(message: object) -> Geometry:
    """Return the geometry that a scan states."""
    return (laser_beams(message), *_limits(message))


def _limits(message: object) -> tuple[float, float]:
    """Return the stated range_min and range_max; all NaN are one object, so that they compare equal."""
    values = (float(field_of("message", message, name)) for name in ("range_min", "range_max"))
    near, far = (math.nan if math.isnan(value) else value for value in values)
    return near, far


@dataclass(frozen=True)
class Beams:
    """Common beams of a laser's scans, in the laser's frame."""

    first: float  # bearing of beam 0 [rad]
    step: float  # step between beams [rad]
    count: int  # number of beams
    range_min: float  # lower limit of ranges [m]
    range_max: float  # upper limit of ranges [m]
    overridden: tuple[bool, bool] = (False, False)  # whether options replace the messages' range_min and range_max
    varied: bool = False  # whether beams vary from scan to scan, so that the common beams cover a full turn

    def scanner(self, mount: Pose, upside_down: bool) -> Scanner:
        """Return the scanner at a mount; bearings of an upside-down laser run clockwise."""
        sign = -1 if upside_down else 1
        return Scanner.uniform(angle_min=sign * self.first, angle_increment=sign * self.step, count=self.count,
                               range_max=self.range_max, range_min=self.range_min, mount=mount)  # fmt: skip

    def take(self, message: object) -> tuple[Floats, NDArray[np.float32] | None, float]:
        """Return read-only readings [m], intensities or None, and the duration [s] of a scan on these beams."""
        first, step, count = laser_beams(message)
        ranges = np.array(field_of("message", message, "ranges"), np.float64)[: distinct_beams(step, count)]
        ranges[ranges == 0] = math.nan
        near, far = _limits(message)
        if not self.overridden[1] and far != self.range_max and 0 < far < math.inf:
            ranges[ranges >= far] = math.inf
        if not self.overridden[0] and near != self.range_min and 0 < near < math.inf:
            ranges[ranges < near] = math.nan
        light = None if self.varied else _intensities(message, len(ranges))
        if (first, step, len(ranges)) != (self.first, self.step, self.count):
            bearings = np.asarray(first + step * np.arange(len(ranges)), np.float64)
            index = nearest_beams(bearings, self.first, self.step, self.count)
            ranges = self._placed(ranges, index, math.nan)
            light = None if light is None else self._placed(light, index, 0.0)
        for values in (ranges, light):
            if values is not None:
                values.setflags(write=False)
        return ranges, light, 0.0 if self.varied else self._duration(message, step)

    def _placed(self, values: NDArray[Any], index: NDArray[np.int64], gap: float) -> NDArray[Any]:
        placed = np.full(self.count, gap, values.dtype)
        placed[index[index >= 0]] = values[index >= 0]
        return placed

    def _duration(self, message: object, step: float) -> float:
        """Return the time from the first beam to the last one [s]; 0 unless the message states a plausible one."""
        try:
            lasted = real_field("message", message, "time_increment") * (self.count - 1)
        except (TypeError, ValueError):
            return 0.0
        if step not in (0, self.step):
            lasted *= abs(self.step / step)
        return lasted if 0 < lasted <= _LONGEST else 0.0


def _intensities(message: object, beams: int) -> NDArray[np.float32] | None:
    """Return the intensities of a scan; None if absent, all equal, or not finite."""
    try:
        light = np.array(field_of("message", message, "intensities"), np.float32)
    except (TypeError, ValueError):
        return None
    if light.ndim != 1 or not 0 < beams <= len(light):
        return None
    known = light[np.isfinite(light)]
    return light[:beams] if len(known) and (known != known[0]).any() else None


def shared_beams(place: str, found: Counter[Geometry], range_min: float | None, range_max: float | None) -> Beams:
    """Choose the beams of most scans of a laser, or of a full turn if they vary; limits [m] replace the messages'."""
    angles_of: Counter[Angles] = Counter()
    nearest: Counter[float] = Counter()
    farthest: Counter[float] = Counter()
    for (angles, low, high), scans in found.items():
        angles_of[angles] += scans
        nearest[low] += scans
        farthest[high] += scans
    near = _most_frequent(place, "range_min", nearest, range_min)
    far = _most_frequent(place, "range_max", farthest, range_max)
    if range_min is None and near >= far:
        raise ValueError(f"{place}: range_min: must be < range_max = {far:g}, got {near:g}; {_remedy('range_min')}")
    overridden, total = (range_min is not None, range_max is not None), found.total()
    if (common := _common_angles(angles_of)) is not None:
        first, step, count = common
        same = sum(
            scans for (angles, low, high), scans in found.items()
            if angles == common and (overridden[0] or max(low, 0.0) == near) and (overridden[1] or high == far)
        )  # fmt: skip
        if same < total:
            warn_user(
                f"{place}: scans with other beams or range limits: {total - same} of {total}; their readings are "
                "placed on the nearest beams of the others"
            )
        return Beams(first, step, distinct_beams(step, count), near, far, overridden, False)
    finest = min((abs(step) for _, step, count in angles_of if count > 1), default=2 * math.pi / _PLACES)
    places = _PLACES * min(max(math.ceil(2 * math.pi / _PLACES / finest - 1e-6), 1), _FINER)
    warn_user(
        f"{place}: beams vary from scan to scan: all scans share {places} beams all round, without intensities and "
        "durations"
    )
    return Beams(-math.pi, 2 * math.pi / places, places, near, far, overridden, True)


def _most_frequent(place: str, name: str, stated: Counter[float], given: float | None) -> float:
    """Return the most frequent limit; ties go to the larger one."""
    if given is not None:
        return given
    value = max(stated, key=lambda each: (stated[each], math.isfinite(each), each))
    if name == "range_min" and -math.inf < value < math.inf:
        return max(value, 0.0)
    if not 0 < value < math.inf:
        rule = "finite and > 0" if name == "range_max" else "finite"
        raise ValueError(f"{place}: {name}: must be {rule}, got {value:g}; {_remedy(name)}")
    return value


def _remedy(name: str) -> str:
    return f"{name}= or --{name.replace('_', '-')} replaces it"


def _common_angles(found: Counter[Angles]) -> Angles | None:
    """Return the angles of more than half of the scans; empty scans count only without others."""
    full = Counter({angles: scans for angles, scans in found.items() if angles[2] > 0}) or found
    best, most = None, 0
    for candidate, _ in full.most_common(_CANDIDATES):
        scans = sum(number for other, number in full.items() if alike(candidate, other))
        if scans > most:
            best, most = candidate, scans
    return best if 2 * most > full.total() else None


def alike(one: Angles, other: Angles) -> bool:
    """Return whether two scans have equally many beams, and bearings that agree within a small share of a step."""
    (first, step, count), (begin, stride, number) = one, other
    apart = max(abs(first - begin), abs(first + step * (count - 1) - begin - stride * (number - 1)))
    return one == other or (count == number and apart < _SAME * abs(step))
