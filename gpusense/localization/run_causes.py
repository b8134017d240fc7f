"""The likely cause of a wrong pose, by the scans of a whole run.

Evidence is of three kinds. The motion between scans contradicts the odometry, or not
(:mod:`gpusense.localization.scan_motion`). A few scans in a row, with their relative poses by matching, fit somewhere
on the map: unchanged, in the order of a laser that is upside down, or with another scale of the map. And their places
agree with the judged poses, or are all moved from them in the same way. :func:`likely_cause` decides by this evidence
alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpusense._util.typing import Floats
from gpusense.localization.beam_consistency import counts_of
from gpusense.localization.belief import motion_between, ratio_of_scan
from gpusense.localization.diagnosis import Diagnosis, evidence_of, explains
from gpusense.localization.rival_search import SPREAD_OF_POSE, RivalSearch
from gpusense.localization.scan_motion import Moment, ScanMotion, Window, mirrored_motion, scan_motion
from gpusense.localization.sensors import Sensor, sensors_of
from gpusense.localization.spread import FAR, FAR_TURN
from gpusense.localization.verdict import sightings
from gpusense.world.pose_algebra import compose_poses, invert_poses, pose_difference, wrap_angle
from gpusense.world.scanner import float64_readings

CAUSES_OF_RUNS = ("odometry", "time", "mount", "scale", "moved")
"""Causes that one scan does not show."""

# Windows whose places are searched; candidates that all scans weigh, and that are refined; poses around each.
_PLACES, _WEIGHED, _REFINED, _AROUND, _REACH = 5, 20, 5, 64, (0.1, 0.1, 0.05)
# Scans of a window that are searched at each scale, and their candidates.
_QUICK, _FEWER = 3, (8, 2)
# Least shares of the beams of a window that agree at its place: of beams that meet walls, and of all informative ones.
_AGREE, _AGREE_OF_ALL = 0.92, 0.5
# Scales of the map that are tried.
_SCALES = tuple(float(scale) for scale in (0.5, *np.geomspace(1 / 1.4, 1.4, 18), 2.0))
# Scales that all windows judge after one window's search; least scale, or its inverse, against a map that partly fits.
_BEST_SCALES, _LEAST_SCALE = 3, 1.08
# Least share of windows that fit where a hypothesis holds, and where it holds throughout; largest where it does not.
_MOST, _ALMOST_ALL, _FEW = 0.6, 0.75, 0.4
# Least share of short beams that names people or furniture; drift of the odometry, as a share of its way [rad/m].
_CROWD, _DRIFT = 0.2, 0.1
# Largest distance between a place and the judged pose that agree [m, rad], and between common displacements.
_SAME, _SAME_TURN = 0.5, 0.2


class Place(NamedTuple):
    """Likeliest place of a window: (3,) pose at its first scan, shares of agreeing and short beams, whether it fits."""

    pose: Floats
    share: float
    fits: bool
    short: float = 0.0


class RunEvidence(NamedTuple):
    """Evidence of a run."""

    motion: ScanMotion  # agreement of the scans' motion with the odometry
    windows: int = 0  # number of windows that were judged
    at_poses: float = 0.0  # share of them that fit at the judged poses
    at_last: bool = False  # true if the last window fits there
    short: float = 0.0  # share of the beams of windows that end in free space, among those that fit
    as_is: float = 0.0  # share of windows that fit somewhere on the map
    mirrored: float = 0.0  # share that fits somewhere as a laser upside down sees it
    scaled: float = 0.0  # share that fits somewhere on a map of another scale
    scale: float = 1.0  # this scale: the ratio of true lengths to lengths on the map
    # Common displacement of the places from the judged poses, in the map; None without one.
    moved: tuple[float, float, float] | None = None
    last: tuple[float, float, float] | None = None  # place of the last window, if it fits


def diagnose_run(models: Any, moments: Sequence[Moment], *, search: bool = True) -> Diagnosis:
    """Return the evidence of the scans of a run, and the likely cause of a contradiction.

    Args:
        models: The model of the scans, or several of one device.
        moments: Scans with the judged poses, and with odometry and times where they are known, in order of time.
        search: True to search places on the map; False to judge the odometry alone.
    """
    sensors = sensors_of(models)
    scanning = [one for one in moments if sensors[one.sensor].calibrates]
    if not scanning:
        return Diagnosis(0, 0, 0)
    # Only the laser with the most scans is used.
    numbers = [one.sensor for one in scanning]
    index = max(set(numbers), key=lambda number: (numbers.count(number), -number))
    chosen = [one for one in scanning if one.sensor == index]
    sensor = sensors[index]
    motion = scan_motion(chosen, sensor.model.scanner, sensor.model.device.selection)
    places = _Places(sensor, chosen)
    evidence = places.evidence(motion) if search else RunEvidence(motion)
    last = moments[-1]
    beams = evidence_of(sightings(sensors, {last.sensor: (last.ranges,)}, np.asarray(last.pose, np.float64)))
    return likely_cause(beams, evidence, search=search)


def likely_cause(beams: Diagnosis, evidence: RunEvidence, *, search: bool = True) -> Diagnosis:
    """Return the diagnosis of a run whose last scan has ``beams``; without a search, its places do not count."""
    motion = evidence.motion
    found = replace(beams, motion=_motion_text(motion), cause="unknown")
    flipped = replace(found, cause="mount", turned=motion.turned if motion.mirrored else 0.0, mirrored=True)
    if motion.cause == "mount":
        if not motion.mirrored:
            return replace(found, cause="mount", turned=motion.turned)
        if not search or evidence.mirrored >= max(_MOST, evidence.as_is):
            return flipped
    if search and evidence.scaled >= _MOST and evidence.scaled > evidence.as_is:
        return replace(found, cause="scale", scale=evidence.scale)
    if search and evidence.as_is < _MOST:
        if evidence.mirrored >= _MOST:
            return flipped
        fitting = max(evidence.as_is, evidence.mirrored, evidence.scaled)
        return replace(found, cause="map" if evidence.windows and fitting <= _FEW else "unknown")
    if motion.cause == "time":
        return replace(found, cause="time", delay=motion.delay)
    if motion.cause in ("odometry", "mount"):
        return replace(found, cause="odometry")
    if not search or (evidence.at_poses >= _MOST and evidence.at_last):
        return replace(found, cause="people" if evidence.short > _CROWD else "none")
    if evidence.moved is not None:
        return replace(found, cause="moved", moved=evidence.moved)
    if evidence.last is not None:
        return replace(found, cause="start", elsewhere=evidence.last)
    return found


def _motion_text(motion: ScanMotion) -> str:
    """Return the evidence of the motion between scans in words; nothing without enough matches."""
    if math.isnan(motion.way):
        return ""
    verb = "agree with" if motion.cause == "none" else "contradict"
    turn = f"{motion.way:.2g} m and {math.degrees(motion.turn):.2g} degrees in the median"
    return f"{motion.matched} of {motion.pairs} pairs of scans match and {verb} the odometry: {turn}"


class _Places:
    """Places of windows on the map, of scans of one sensor."""

    def __init__(self, sensor: Sensor, moments: Sequence[Moment]) -> None:
        self._sensor, self._moments = sensor, moments
        self._search = RivalSearch([sensor])

    def evidence(self, motion: ScanMotion) -> RunEvidence:
        """Return the evidence of a run with the motion between its scans."""
        windows = self._chosen(motion.windows)
        count = len(windows)
        judged = [self._judged([*map(self._ranges, one.moments)], np.array([*map(self._pose, one.moments)]))
                  for one in windows]  # fmt: skip
        fitting = [one for one in judged if one.fits]
        known = RunEvidence(
            motion, count, len(fitting) / count, judged[-1].fits,
            float(np.mean([one.short for one in fitting])) if fitting else 0.0,
        )  # fmt: skip
        if known.at_last and known.at_poses >= _ALMOST_ALL:
            return known._replace(as_is=known.at_poses)
        steady = motion.cause == "none"
        found = [self.place(window) for window in windows]
        fits = self._consistent(windows, found, steady=steady)
        known = known._replace(as_is=max(float(fits.mean()), known.at_poses))
        here = np.array([one.fits and self._is_near(window, one) for window, one in zip(windows, found, strict=True)])
        known = known._replace(
            at_poses=max(known.at_poses, float(here.mean())), at_last=known.at_last or bool(here[-1])
        )
        if found[-1].fits:
            x, y, theta = (float(value) for value in found[-1].pose)
            known = known._replace(last=(x, y, theta))
        known = known._replace(moved=self._displacement(windows, found, fits))
        # A few windows also fit a map of another scale, so a map that others do not fit competes with all scales.
        if known.as_is >= _MOST and not motion.mirrored:
            return self._scaled(windows, known, steady=True) if steady and known.as_is < 1 else known
        steady = steady or motion.mirrored
        known = known._replace(mirrored=self._share(windows, steady=steady, mirrored=True)[0])
        if max(known.as_is, known.mirrored) >= _MOST:
            return known
        return self._scaled(windows, known, steady=steady)

    def _chosen(self, windows: list[Window]) -> list[Window]:
        """Return the windows that are judged: the first, the last, and long ones between them."""
        if not windows:
            every = np.linspace(0, len(self._moments) - 1, min(_PLACES, len(self._moments))).astype(int)
            return [Window((int(k),), np.zeros((1, 3))) for k in every]
        parts = np.array_split(np.arange(len(windows)), min(_PLACES, len(windows)))
        longest = [max(part.tolist(), key=lambda k: len(windows[k].relative)) for part in parts]
        return [windows[k] for k in sorted({0, *longest[1:-1], len(windows) - 1})]

    def _consistent(
        self, windows: list[Window], places: list[Place], *, steady: bool, scale: float = 1.0
    ) -> NDArray[np.bool_]:
        """Return which places fit, and for a right odometry (``steady``) a second place at the distance it states."""
        fits = np.array([one.fits for one in places])
        odometry = [self._moments[window.moments[0]].odometry for window in windows]
        if not steady or len(windows) < 3 or any(one is None for one in odometry):
            return fits
        moved, found = np.array(odometry, np.float64), np.array([one.pose for one in places])
        by_odometry = pose_difference(moved[:, None], moved[None]) / np.array([scale, scale, 1.0])
        apart = pose_difference(by_odometry, pose_difference(found[:, None], found[None]))
        way, turn = np.hypot(*np.moveaxis(by_odometry[..., :2], -1, 0)), np.abs(by_odometry[..., 2])
        near = np.hypot(*np.moveaxis(apart[..., :2], -1, 0)) < 2 * _SAME + _DRIFT * way
        near &= np.abs(apart[..., 2]) < _SAME_TURN + _DRIFT * (turn + way)
        near &= fits[:, None] & fits[None] & ~np.eye(len(fits), dtype=bool)
        return np.asarray(near.any(axis=1))

    def _scaled(self, windows: list[Window], known: RunEvidence, *, steady: bool) -> RunEvidence:
        """Return the evidence with the scale of the map that most windows fit."""
        for tried in (windows[len(windows) // 2], windows[len(windows) // 4]):
            places = {scale: self.place(tried, scale=scale, quick=True) for scale in _SCALES}
            fitting = [scale for scale in _SCALES if places[scale].fits]
            if known.as_is >= _MOST:
                fitting = [scale for scale in fitting if max(scale, 1 / scale) >= _LEAST_SCALE]
            best = sorted(fitting, key=lambda scale: -places[scale].share)[:_BEST_SCALES]
            shares = {scale: self._share(windows, steady=steady, scale=scale) for scale in best}
            # Windows also fit at neighbouring scales, but fewer of their beams agree.
            scale = max(best, key=lambda scale: shares[scale], default=1.0)
            if best and shares[scale][0] > known.scaled:
                known = known._replace(scaled=shares[scale][0], scale=scale)
            if known.scaled >= _ALMOST_ALL:
                break
        return known

    def _share(
        self, windows: list[Window], *, steady: bool, mirrored: bool = False, scale: float = 1.0
    ) -> tuple[float, float]:
        """Return the share of windows that fit with a hypothesis, and the mean share of their beams that agree.

        The search ends where the hypothesis cannot hold any more.
        """
        found: list[Place] = []
        for window in windows:
            found.append(self.place(window, mirrored=mirrored, scale=scale))
            if sum(not one.fits for one in found) > (1 - _MOST) * len(windows):
                return sum(one.fits for one in found) / len(windows), 0.0
        fits = self._consistent(windows, found, steady=steady, scale=scale)
        return float(fits.mean()), float(np.mean([one.share for one in found]))

    def _displacement(
        self, windows: list[Window], places: list[Place], fits: NDArray[np.bool_]
    ) -> tuple[float, float, float] | None:
        """Return the common motion from the judged poses to the places that fit; None without one."""
        if fits.sum() < 3 or not fits[0]:
            return None
        before = np.array([self._pose(window.moments[0]) for window in windows])[fits]
        after = np.array([one.pose for one in places])[fits]
        moves = compose_poses(after, invert_poses(before))
        middle = moves[np.argsort(moves[:, 2])[len(moves) // 2]]
        apart = pose_difference(compose_poses(middle, before), after)
        center = np.array([*before[:, :2].mean(axis=0), 0.0])
        x, y, theta = (float(value) for value in compose_poses(middle, center) - center)
        same = (np.hypot(*apart[:, :2].T) < 2 * _SAME) & (np.abs(wrap_angle(apart[:, 2])) < _SAME_TURN)
        is_moved = math.hypot(x, y) > _SAME or abs(theta) > _SAME_TURN
        return (x, y, theta) if same.mean() >= _ALMOST_ALL and is_moved else None

    def _is_near(self, window: Window, place: Place) -> bool:
        """Tell whether a place is the judged pose of its window."""
        way, turn = motion_between(place.pose, self._pose(window.moments[0]))
        return way < FAR and turn < FAR_TURN

    def _pose(self, moment: int) -> Floats:
        return np.asarray(self._moments[moment].pose, np.float64)

    def place(self, window: Window, *, mirrored: bool = False, scale: float = 1.0, quick: bool = False) -> Place:
        """Return the likeliest place of a window on the map, by a few of its scans for ``quick``."""
        scans, relative = self._seen(window, mirrored, scale)
        if quick:
            scans, relative = scans[:_QUICK], relative[:_QUICK]
        field = self._search.field_of(self._sensor)
        ends = [0] if quick else sorted({0, len(scans) - 1})
        poses = np.vstack([
            compose_poses(found, invert_poses(relative[k]))
            for k in ends
            if len(found := self._search.likely(self._sensor, scans[k], quick=quick))
        ] or [np.empty((0, 3))])  # fmt: skip
        # Among people a field prefers places with many walls, so beams through walls count first.
        weighed, refined = _FEWER if quick else (_WEIGHED, _REFINED)
        for number, count in ((1, weighed), (len(scans), refined)):
            ratios = np.array([self._ratio(scans[:number], relative, pose) for pose in poses])
            poses = poses[np.argsort(ratios, kind="stable")[:count]]
        if not len(poses):
            return Place(np.zeros(3), 0.0, fits=False)

        def score(tried: Floats) -> Floats:
            total = np.zeros(len(tried))
            for one, scan in zip(relative, scans, strict=True):
                total += np.asarray(field.log_likelihood(compose_poses(tried, one), scan), np.float64)
            return total

        rng, judged = np.random.default_rng(0), []
        for best in poses:
            for reach in (1.0, 0.3):
                offsets = rng.uniform(-reach, reach, (_AROUND, 3)) * _REACH
                offsets[0] = 0.0
                tried = best + offsets
                best = tried[int(np.argmax(score(tried)))]
            judged.append(self._judged(scans, compose_poses(best, relative)))
        return max(judged, key=lambda one: (one.fits, one.share))

    def _ratio(self, scans: list[Floats], relative: Floats, pose: Floats) -> float:
        """Return the sum of the ratios of scans at a coarse pose."""
        ratios = [
            ratio_of_scan(sightings([self._sensor], {0: (scan,)}, compose_poses(pose, part), SPREAD_OF_POSE))
            for part, scan in zip(relative, scans, strict=False)
        ]
        return float(np.nan_to_num(ratios).sum())

    def _ranges(self, moment: int) -> Floats:
        return float64_readings(np.asarray(self._moments[moment].ranges), self._sensor.model.scanner)

    def _judged(self, scans: list[Floats], poses: Floats) -> Place:
        """Return the place of scans with all their beams judged at (L, 3) poses."""
        pairs = zip(poses, scans, strict=True)
        seen = [one for pose, scan in pairs for one in sightings([self._sensor], {0: (scan,)}, pose)]
        counts, is_right = counts_of(seen), explains(seen, _AGREE, _AGREE_OF_ALL)
        every = max(counts.informative_count, 1)
        return Place(poses[0], counts.agree / every, is_right, counts.short / every)

    def _seen(self, window: Window, mirrored: bool, scale: float) -> tuple[list[Floats], Floats]:
        """Return the scans of a window and their relative poses, as on a map of another scale or by a turned laser."""
        scanner, relative = self._sensor.model.scanner, window.relative
        scans = [self._ranges(k) for k in window.moments[: len(relative)]]
        if mirrored:
            scans, relative = [scan[::-1] for scan in scans], mirrored_motion(relative, scanner)
        if scale != 1:
            scans = [np.where(scan >= scanner.range_max, np.inf, scan / scale) for scan in scans]
            # A reading beyond the laser's range is no sign of free space.
            scans = [np.where(np.isfinite(scan) & (scan >= scanner.range_max), np.nan, scan) for scan in scans]
            relative = relative * np.array([1 / scale, 1 / scale, 1.0])
        return scans, relative
