"""Report evidence for and against a pose, and the likely cause of a contradiction."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from gpusense._util.typing import Floats
from gpusense.interface.constants import THROUGH
from gpusense.localization.beam_consistency import BeamConsistency, counts_of
from gpusense.localization.belief import ratio_of_scan
from gpusense.localization.sensors import Sensor
from gpusense.localization.verdict import sightings
from gpusense.matching.field_search import searchable

Cause = Literal["none", "people", "start", "moved", "mount", "map", "scale", "odometry", "time", "unknown"]

# Number of poses tried elsewhere on the map, of refined best poses, and of refinements of each; largest displacement.
_TRIED, _REFINED, _AROUND, _REACH = 8192, 12, 64, (0.4, 0.4, 0.2)
# Least agreeing shares of a pose that explains a scan: among beams that meet walls, and among informative beams.
_FITS, _FITS_OF_ALL = 0.85, 0.6
# Least angle of a wrong mount [rad]; number of tried angles.
_LEAST_TURN, _TURNS = math.radians(20), 72
# Radius of a place where beams pass through [m]; least distance of a second place [m]; share of beams shortened by a
# crowd.
_ONE_PLACE, _ELSEWHERE, _CROWD = 1.5, 1.0, 0.3
# Most points in the search for the place.
_MOST_POINTS = 1000


@dataclass(frozen=True)
class Diagnosis:
    """Evidence of the last readings at a pose.

    Attributes:
        agree: Number of beams that end at a mapped wall.
        through: Number of beams that pass through a mapped wall.
        short: Number of beams that end in mapped free space.
        place: (x, y) of the wall where most beams pass through [m], or None.
        inside: True if the pose is inside solid cells.
        off: True if the pose is in unknown cells or off the map.
        elsewhere: (x, y, theta) of a pose that explains the scan better; None if there is none, or without a search.
        turned: Apparent turn of the scanner relative to its mount [rad]; pi and ``mirrored`` for a scanner that is
            upside down; None if the mount fits or no other mount does.
        mirrored: Whether the readings seem to be in the opposite order.
        cause: Likely cause: "none" (nothing contradicts the pose), "people" (some beams are short, none long), "start"
            (the robot is elsewhere on this map), "mount" (the scanner has another mount), "map" (no place of the map
            explains the scan) or "unknown". From the scans of a run also "moved" (all places are displaced from the
            poses by the same motion), "scale" (the map has another resolution), "odometry" (matched scans contradict
            it) and "time" (the scans fit the odometry of another time).
        motion: How the motion between the scans of a run compares with the odometry, in words.
        moved: (x, y, theta) displacement of the places on the map from the poses, at their centre; None without one.
        scale: Ratio of true lengths to lengths on the map; 1 if they agree.
        delay: Time of the fitting odometry less the time of the scan [s]; 0 if they agree.

    Example:
        >>> import gpusense as gs
        >>> gs.Diagnosis(12, 8, 3, (4.0, 1.5), cause="map").text
        '40 % of the beams that meet walls pass through them, most near x = 4.0, y = 1.5; likely cause: wrong map'
    """

    agree: int
    through: int
    short: int
    place: tuple[float, float] | None = None
    inside: bool = False
    off: bool = False
    elsewhere: tuple[float, float, float] | None = None
    turned: float | None = None
    mirrored: bool = False
    cause: Cause = "unknown"
    motion: str = ""
    moved: tuple[float, float, float] | None = None
    scale: float = 1.0
    delay: float = 0.0

    @property
    def counted(self) -> int:
        """Number of beams with evidence."""
        return self.agree + self.through + self.short

    @property
    def text(self) -> str:
        """The evidence and the likely cause in one line."""
        parts = [self._beams()]
        if self.inside:
            parts.append("the pose is inside solid cells")
        if self.off:
            parts.append("the pose is in unknown cells or off the map")
        if self.motion:
            parts.append(self.motion)
        cause = self._cause()
        return "; ".join([*parts, f"likely cause: {cause}"] if cause else parts)

    def _beams(self) -> str:
        if not self.counted:
            return "no beam meets mapped cells that give evidence"
        met = self.agree + self.through
        if self.through and 10 * self.through >= met:
            at = "" if self.place is None else ", most near x = {:.1f}, y = {:.1f}".format(*self.place)
            return f"{100 * self.through / met:.0f} % of the beams that meet walls pass through them{at}"
        return f"{100 * self.agree / self.counted:.0f} % of the beams agree with the map"

    def _cause(self) -> str:
        if self.cause == "unknown":
            return "unknown" if self.counted or self.inside or self.off or self.motion else ""
        if self.cause == "start" and self.elsewhere is not None:
            return "wrong start, or carried away: x = {:.1f}, y = {:.1f}, theta = {:.2f} fits".format(*self.elsewhere)
        if self.cause == "moved" and self.moved is not None:
            return "map or start moved: places are off the poses by x = {:.1f}, y = {:.1f}, theta = {:.2f}".format(
                *self.moved
            )
        if self.cause == "mount":
            how = "mirrored" if self.mirrored else f"turned by {math.degrees(self.turned or 0.0):.0f} degrees"
            return f"wrong mount: the scan fits {how}"
        return {
            "people": "people or furniture that the map lacks",
            "map": "wrong map",
            "scale": f"wrong resolution: true lengths are {self.scale:.2f} times those of the map",
            "odometry": "wrong odometry",
            "time": f"wrong times: the scans fit the odometry {abs(self.delay):.2f} s "
            f"{'later' if self.delay > 0 else 'earlier'}",
        }.get(self.cause, "")

    def __str__(self) -> str:
        return self.text


def diagnose(
    sensors: Sequence[Sensor],
    readings: Mapping[int, tuple[Any, ...]],
    pose: Floats,
    random_poses: Callable[[int], Floats] | None,
) -> Diagnosis:
    """Return the evidence of readings at a pose (3,); None for ``random_poses`` skips the search elsewhere."""
    scans = sightings(sensors, readings, pose)
    found = evidence_of(scans)
    if not found.counted and not (found.inside or found.off):
        return found
    if explains(scans) or ratio_of_scan(scans) < 0:
        crowded = found.short > _CROWD * found.counted
        return replace(found, cause="people" if crowded else "none")
    if random_poses is None:
        return found
    turned, mirrored = _mount(sensors, readings, pose)
    if turned is not None:
        return replace(found, turned=turned, mirrored=mirrored, cause="mount")
    best = _best_elsewhere(sensors, readings, random_poses)
    if best is None or math.dist(best[:2], pose[:2]) < _ELSEWHERE:
        return found
    if explains(sightings(sensors, readings, best)):
        x, y, theta = (float(value) for value in best)
        return replace(found, elsewhere=(x, y, theta), cause="start")
    return replace(found, cause="map")


def evidence_of(scans: Sequence[BeamConsistency]) -> Diagnosis:
    """Return the evidence of judged beams, without a cause."""
    counts = counts_of(scans)
    inside, off = any(one.inside for one in scans), any(one.off for one in scans)
    return Diagnosis(counts.agree, counts.through, counts.short, _place(scans), inside, off)


def explains(scans: Sequence[BeamConsistency], of_walls: float = _FITS, of_all: float = _FITS_OF_ALL) -> bool:
    """Return whether larger shares of the beams that meet walls, and of all informative beams, agree at a pose."""
    counts = counts_of(scans)
    least = max(of_walls * (counts.agree + counts.through), of_all * counts.informative_count)
    return counts.agree > least and not any(one.inside or one.off for one in scans)


def _place(scans: Sequence[BeamConsistency]) -> tuple[float, float] | None:
    """Return the wall where most beams pass through; None without such beams."""
    walls = [one.wall[one.kind == THROUGH] for one in scans]
    points = np.concatenate(walls) if walls else np.zeros((0, 2))
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return None
    points = points[:: len(points) // _MOST_POINTS + 1]
    near = np.hypot(*(points[:, None] - points[None]).T) < _ONE_PLACE
    x, y = points[near[int(np.argmax(near.sum(axis=1)))]].mean(axis=0)
    return float(x), float(y)


def _mount(
    sensors: Sequence[Sensor], readings: Mapping[int, tuple[Any, ...]], pose: Floats
) -> tuple[float | None, bool]:
    """Return the turn that makes scans fit at a pose (or None), and whether they are mirrored."""
    best: tuple[float, float | None, bool] = (0.0, None, False)
    scans = {index: reading[0] for index, reading in readings.items() if sensors[index].calibrates}
    for mirrored in (False, True):
        seen = {index: (ranges[::-1] if mirrored else ranges,) for index, ranges in scans.items()}
        for k in range(_TURNS):
            angle = math.remainder(k * math.tau / _TURNS, math.tau)
            if not mirrored and abs(angle) < _LEAST_TURN:
                continue
            found = sightings(sensors, seen, pose + np.array([0.0, 0.0, angle]))
            agree = counts_of(found).agree
            if agree > best[0] and explains(found):
                best = agree, angle, mirrored
    return best[1], best[2]


def _best_elsewhere(
    sensors: Sequence[Sensor], readings: Mapping[int, tuple[Any, ...]], random_poses: Callable[[int], Floats]
) -> Floats | None:
    """Return the likeliest of random poses after refinement; None if no sensor has a map."""
    scanning = {index: reading for index, reading in readings.items() if sensors[index].calibrates}
    if not scanning:
        return None

    def score(poses: Floats) -> Floats:
        total = np.zeros(len(poses))
        for index, reading in scanning.items():
            total += np.asarray(searchable(sensors[index].model).log_likelihood(poses, *reading), np.float64)
        return total

    poses, rng = random_poses(_TRIED), np.random.default_rng(0)
    for reach in (1.0, 0.3, 0.1):
        best = poses[np.argsort(-score(poses), kind="stable")[:_REFINED]]
        offsets = rng.uniform(-reach, reach, (_REFINED, _AROUND, 3)) * _REACH
        offsets[:, 0] = 0.0
        poses = (best[:, None] + offsets).reshape(-1, 3)
    return np.asarray(poses[int(np.argmax(score(poses)))])
