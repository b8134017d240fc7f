"""Judge the trajectory of any localiser by the scans of a recording: when it was right, when lost, where it was."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks
from gpusense._util.typing import AnyArray, Floats
from gpusense.evaluation.log_steps import NEAR
from gpusense.evaluation.tracking import RISK, Track
from gpusense.evaluation.trajectory_files import nearest_index, poses_at
from gpusense.localization.diagnosis import Diagnosis
from gpusense.localization.monitor import PoseMonitor
from gpusense.localization.run_causes import diagnose_run
from gpusense.localization.scan_motion import Moment
from gpusense.localization.spread import FAR, WORDS, Word, check_risk
from gpusense.logs import Pose, Scan
from gpusense.matching.locate import locate_scan
from gpusense.matching.location import Location
from gpusense.models.scan.field import LikelihoodFieldModel
from gpusense.models.scan.model import ScanModel
from gpusense.world.scanner import Scanner

# A stretch ends where no pose is judged for this time [s], and for this multiple of the median time between them.
_GAP, _GAP_STEPS = 2.0, 5.0
# Most stretches to search, lost ones first and then the longest; most lost stretches to diagnose as a whole.
_SEARCHED, _DIAGNOSED = 12, 3
# Largest difference between copies of a position [m].
_SAME = 1e-3
# Evidence of the beams of a scan in a diagnosis.
_BEAMS = ("agree", "through", "short", "place", "inside", "off")
# Steps of the search for the place of a scan [m, rad].
_RESOLUTION, _ANGLE = 0.1, math.radians(3)


@dataclass(frozen=True, eq=False)
class Stretch:
    """Successive poses with the same verdict.

    Attributes:
        verdict: "tracking", "uncertain" or "lost".
        first: Row of the first pose.
        last: Row of the last pose.
        start: Time of the first pose [s].
        end: Time at which the next stretch begins, or of the last pose if none follows at once [s].
        p_lost: Largest p_lost.
        explained: Median share of the beams that agree with the map; NaN without one.
        radius: Median radius of protection [m].
        promised: Share of the poses with a finite radius.
        pose: (3,) pose at the scan that was searched, else the last pose [m, m, rad].
        place: The likeliest place of the scan at ``pose``; None without a search.
        diagnosis: Evidence at ``pose`` and the likely cause; None for "tracking", and without a search.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> gs.Stretch("tracking", 0, 9, 12.0, 13.5, 0.02, 0.97, 0.1, 1.0, np.zeros(3)).duration
        1.5
    """

    verdict: Word
    first: int
    last: int
    start: float
    end: float
    p_lost: float
    explained: float
    radius: float
    promised: float
    pose: Floats
    place: Location | None = field(default=None, repr=False)
    diagnosis: Diagnosis | None = field(default=None, repr=False)

    @property
    def duration(self) -> float:
        """Time from start to end [s]."""
        return self.end - self.start

    @property
    def off(self) -> float:
        """Distance from the pose to the likeliest place of its scan [m]; NaN without such a place."""
        if self.place is None or self.place.status == "no match":
            return math.nan
        return float(np.hypot(*(self.place.pose - self.pose)[:2]))


@dataclass(frozen=True, eq=False)
class Judgement:
    """Verdicts on the poses of a localiser: N poses of S scans.

    Attributes:
        scans: Number of scans; only scans with a pose are judged.
        index: (N,) index of the scan of each pose.
        times: (N,) times [s].
        poses: (N, 3) poses [m, m, rad].
        p_lost: (N,) probabilities that the pose is off by more than 1 m or 0.5 rad.
        verdicts: N times "tracking", "uncertain" or "lost".
        explained: (N,) shares of the beams that agree with the map; NaN without one.
        radii: (N,) radii that the error of the position exceeds with at most the probability ``risk`` [m]; infinite
            where that cannot be promised.
        risk: The probability.
        stretches: Successive poses with the same verdict.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> n = np.arange(3.0)
        >>> gs.Judgement(4, n.astype(int), n, np.zeros((3, 3)), n / 9, ("tracking",) * 3, n, n, 0.05, ()).lost
        False
    """

    scans: int
    index: NDArray[np.int64]
    times: Floats
    poses: Floats
    p_lost: Floats
    verdicts: tuple[Word, ...]
    explained: Floats
    radii: Floats
    risk: float
    stretches: tuple[Stretch, ...]

    def __repr__(self) -> str:
        parts = ", ".join(f"{word} {self.duration(word):.1f} s" for word in ("tracking", "uncertain", "lost"))
        return f"Judgement({len(self.times)} of {self.scans} scans, {parts})"

    @property
    def lost(self) -> bool:
        """Tell whether a pose was lost."""
        return "lost" in self.verdicts

    @property
    def informed(self) -> bool:
        """Tell whether a scan had a beam to judge by."""
        return bool(np.isfinite(self.explained).any())

    def duration(self, verdict: Word | None = None) -> float:
        """Return the time with a verdict; with any for None [s]."""
        if verdict is not None:
            checks.choice("verdict", verdict, WORDS)
        return float(sum(one.duration for one in self.stretches if verdict in (None, one.verdict)))


class TrajectoryJudge:
    """Judges a trajectory, scan by scan."""

    def __init__(self, models: ScanModel | list[ScanModel], *, risk: float = RISK, searches: int = 5) -> None:
        """Begin; the arguments are those of :func:`judge_trajectory`."""
        each = list(models) if isinstance(models, (list, tuple)) else [models]
        for model in each:
            if not isinstance(model, ScanModel):
                raise TypeError(f"models: must be a model of scans or a list of them, got {checks.show(model)}")
        self._models: dict[Scanner, ScanModel] = {model.scanner: model for model in each}
        self._searches = checks.integer("searches", searches, low=0)
        self._risk = check_risk(risk)
        self._monitor = PoseMonitor(each)
        self._locators: dict[Scanner, LikelihoodFieldModel] = {}
        self._judged: list[tuple[int, Scan, Moment, tuple[float, Word, float, float]]] = []

    def __len__(self) -> int:
        """Return the number of judged poses."""
        return len(self._judged)

    def add(
        self, index: int, scan: Scan, pose: AnyArray, covariance: AnyArray | None = None, odometry: Pose | None = None
    ) -> Word:
        """Judge the pose (3,) of a scan; return the verdict. The odometry of the scan is the default."""
        model = self._models.get(scan.scanner)
        if model is None:
            raise ValueError(f"scans: every scanner must have a model, got none for that of scan {index}")
        verdict = self._monitor.update(pose, {model: scan.ranges}, covariance)
        radius = verdict.protection_level(self._risk)
        place = np.array(pose, np.float64)
        sensor = list(self._models).index(scan.scanner)
        moment = Moment(scan.ranges, place, odometry or scan.odometry, scan.time, sensor)
        self._judged.append((index, scan, moment, (verdict.p_lost, verdict.verdict, verdict.explained, radius)))
        return verdict.verdict

    def result(self, scans: int) -> Judgement:
        """Return the judgement of the poses so far, of ``scans`` scans."""
        index, times = [one[0] for one in self._judged], np.array([one[1].time for one in self._judged])
        poses = np.array([one[2].pose for one in self._judged]).reshape(-1, 3)
        p_lost, verdicts, explained, radii = zip(*(one[3] for one in self._judged), strict=True)
        columns = [np.array(column, np.float64) for column in (p_lost, explained, radii)]
        stretches = stretches_of(times, poses, verdicts, *columns)
        doubted = [one for one in stretches if one.verdict != "tracking"]
        worst = sorted(doubted, key=lambda one: (one.verdict != "lost", one.first - one.last))[:_SEARCHED]
        explained_stretches = {
            one.first: self._explained(one, of_run=one.verdict == "lost" and k < _DIAGNOSED)
            for k, one in enumerate(worst)
        }
        return Judgement(
            scans, np.array(index, np.int64), times, poses, columns[0], tuple(verdicts), columns[1], columns[2],
            self._risk, tuple(explained_stretches.get(one.first, one) for one in stretches),
        )  # fmt: skip

    def _explained(self, stretch: Stretch, *, of_run: bool) -> Stretch:
        """Return a stretch with its likely cause, ``of_run`` by all its scans, and if lost the likeliest place."""
        count = min(self._searches, stretch.last - stretch.first + 1)
        if not count:
            return stretch
        rows = np.unique(np.linspace(stretch.first, stretch.last, count).round().astype(int))
        found: list[Stretch] = []
        for row in rows:
            _, scan, moment, _ = self._judged[row]
            place = self._locate(scan) if stretch.verdict == "lost" else None
            found.append(replace(stretch, pose=moment.pose, place=place, diagnosis=self._diagnose(scan, moment.pose)))
        # The surest search decides.
        best = max(found, key=lambda one: -1.0 if one.place is None else one.place.p_right)
        assert best.diagnosis is not None
        if of_run and len(rows) > 1:
            run = self._diagnose_run(stretch)
            if run.cause not in ("none", "unknown"):
                # The last scans of a stretch may be right again: show the beams of the searched scan.
                beams = {name: getattr(best.diagnosis, name) for name in _BEAMS}
                return replace(best, diagnosis=replace(run, **beams))
        if best.place is not None and best.place.found and best.off > FAR:
            x, y, theta = best.place.pose.tolist()
            return replace(best, diagnosis=replace(best.diagnosis, elsewhere=(x, y, theta), cause="start"))
        diagnoses = [one.diagnosis for one in found if one.diagnosis is not None]
        causes = [one.cause for one in diagnoses]
        usual = max(causes, key=causes.count)
        return replace(best, diagnosis=next(one for one in diagnoses if one.cause == usual))

    def _diagnose_run(self, stretch: Stretch) -> Diagnosis:
        """Return the likely cause by the scans of a stretch in sequence."""
        moments = [one[2] for one in self._judged[stretch.first : stretch.last + 1]]
        odometry, poses = (np.array([getattr(one, name) for one in moments]) for name in ("odometry", "pose"))
        # A log without odometry has the same pose throughout; a topic with the judged poses is no odometry.
        if not np.ptp(odometry, axis=0).any() or np.abs((odometry - poses)[:, :2]).max() < _SAME:
            moments = [one._replace(odometry=None) for one in moments]
        return diagnose_run(list(self._models.values()), moments)

    def _diagnose(self, scan: Scan, pose: Floats) -> Diagnosis:
        model = self._models[scan.scanner]
        monitor = PoseMonitor(model)
        monitor.update(pose, scan.ranges)
        return monitor.diagnose()

    def _locate(self, scan: Scan) -> Location:
        if scan.scanner not in self._locators:
            model = self._models[scan.scanner]
            if not (isinstance(model, LikelihoodFieldModel) and model.compat is None):
                model = LikelihoodFieldModel(
                    model.grid, scan.scanner, beams=model.beams, backend=model.device.selection
                )
            self._locators[scan.scanner] = model
        return locate_scan(self._locators[scan.scanner], scan.ranges, resolution=_RESOLUTION, angle=_ANGLE)


def judge_trajectory(
    models: ScanModel | list[ScanModel],
    scans: Sequence[Scan],
    poses: AnyArray,
    *,
    times: AnyArray | None = None,
    covariances: AnyArray | None = None,
    risk: float = RISK,
    searches: int = 5,
) -> Judgement:
    """Judge the poses of any localiser by the scans of a recording.

    :class:`PoseMonitor` judges the pose of each scan in turn. :func:`locate_scan` searches the whole map
    for the places of some scans of each lost stretch.

    Args:
        models: The scan model, or a list of models on one device, one for each scanner.
        scans: S scans in the order of time.
        poses: (S, 3) poses of the robot at the scans [m, m, rad], NaN where unknown; or with ``times`` (T, 3) poses.
        times: (T,) increasing times of the poses [s], which are then interpolated at the scans: between poses at most
            0.5 s apart, else the pose within 0.05 s. None if each scan has a pose.
        covariances: (S, 3, 3) or (T, 3, 3) covariances of the poses, NaN for a pose without one; None for none.
        risk: Probability that the error of the position exceeds the radius of protection, from 0.01 to 1.
        searches: Scans of a stretch that are searched and diagnosed.

    Raises:
        TypeError, ValueError: An argument breaks its rule, no scan has a pose, or a scan has a scanner without a model.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> room = gs.OccupancyGrid(np.pad(np.zeros((50, 80), int), 1, constant_values=100), 0.1)
        >>> model = gs.LikelihoodFieldModel(room, gs.Scanner(np.arange(-3, 3, 0.2), range_max=9.0), backend="numpy")
        >>> z = gs.RayCaster(room, range_max=9.0, backend="numpy").cast([[2.0, 3.0, 0.5]], model.scanner.bearings)[0]
        >>> scans = [gs.Scan(0.1 * k, z, model.scanner, (0, 0, 0), None) for k in range(20)]
        >>> gs.judge_trajectory(model, scans, [[2.0, 3.0, 0.5]] * 20)
        Judgement(20 of 20 scans, tracking 1.9 s, uncertain 0.0 s, lost 0.0 s)
    """
    if not isinstance(scans, (list, tuple)) or not all(isinstance(scan, Scan) for scan in scans):
        raise TypeError(f"scans: must be a list of Scan, got {checks.show(scans)}")
    if not scans:
        raise ValueError("scans: must have a scan, got none")
    count = "S" if times is None else "T"
    places = checks.array("poses", poses, (count, 3), finite=False)
    spread = (
        None if covariances is None else checks.array("covariances", covariances, (len(places), 3, 3), finite=False)
    )
    if times is not None:
        known = checks.array("times", times, (len(places),))
        if not (np.diff(known) > 0).all():
            raise ValueError("times: must increase, got times that do not")
        at = [scan.time for scan in scans]
        if spread is not None:
            spread = spread[nearest_index(at, known)]
        none = (math.nan,) * 3
        places = np.array([pose or none for pose in poses_at(at, known, places, near=NEAR, name="poses")])
    if len(places) != len(scans):
        raise ValueError(f"poses: must be as many as scans, {len(scans)}, or come with times, got {len(places)}")
    judge = TrajectoryJudge(models, risk=risk, searches=searches)
    judged = np.flatnonzero(np.isfinite(places).all(axis=1))
    if not len(judged):
        raise ValueError("poses: must have a pose of a scan, got none that is finite")
    for k in judged.tolist():
        unknown = spread is None or np.isnan(spread[k]).any()
        try:
            judge.add(k, scans[k], places[k], None if unknown or spread is None else spread[k])
        except ValueError as error:
            raise ValueError(f"scans, poses or covariances: at scan {k}: {error}") from None
    return judge.result(len(scans))


def errors_of(found: Judgement, times: Floats, poses: Floats) -> Floats:
    """Return (N,) distances of judged poses from a true trajectory of T poses [m]; NaN where it has no pose."""
    none = (math.nan,) * 3
    true = np.array([pose or none for pose in poses_at(found.times.tolist(), times, poses, name="--truth")])
    return np.asarray(np.hypot(*(found.poses - true)[:, :2].T))


def stretches_of(
    times: Floats, poses: Floats, verdicts: Sequence[Word], p_lost: Floats, explained: Floats, radii: Floats
) -> list[Stretch]:
    """Return the stretches of N successive poses (N, 3) with the same verdict, and without a long gap of time."""
    steps = np.diff(times)
    longest = max(_GAP, _GAP_STEPS * float(np.median(steps))) if len(steps) else _GAP
    # A stretch also ends where the clock goes back.
    gap = np.append((steps > longest) | (steps < 0), True)
    ends = [k for k in range(len(times)) if gap[k] or verdicts[k + 1] != verdicts[k]]
    stretches = []
    for first, last in zip([0, *(k + 1 for k in ends)], ends, strict=False):
        part = slice(first, last + 1)
        known = explained[part][np.isfinite(explained[part])]
        end = times[last] if gap[last] else times[last + 1]
        share = float(np.median(known)) if len(known) else math.nan
        stretches.append(
            Stretch(verdicts[first], first, last, float(times[first]), float(end), float(p_lost[part].max()), share,
                    float(np.median(radii[part])), float(np.isfinite(radii[part]).mean()), poses[last])
        )  # fmt: skip
    return stretches


def stretches_of_track(track: Track) -> list[Stretch]:
    """Return the stretches of a filter's track."""
    times = np.array([step.scan.time for step in track.steps])
    columns = (np.array(values, np.float64) for values in (track.p_lost, track.explained, track.radii))
    return stretches_of(times, np.array(track.poses).reshape(-1, 3), track.verdicts, *columns)
