"""Judge the poses of any localiser by its readings."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gpusense._util import checks
from gpusense._util.typing import AnyArray
from gpusense.localization import starts
from gpusense.localization.diagnosis import Diagnosis, diagnose
from gpusense.localization.sensors import readings_of, sensors_of
from gpusense.localization.spread import (
    Distances,
    JudgedPose,
    Word,
    distances_by_scan,
    margins_of,
    share_off,
    spread_of,
    verdict_label,
)
from gpusense.localization.verdict import Verdict, VerdictState
from gpusense.world.scanner import float64_readings

# Number of poses drawn from a covariance for predicting features.
_DRAWN = 64


@dataclass(frozen=True)
class PoseVerdict(JudgedPose):
    """Verdict on a pose.

    Attributes:
        p_lost: Probability that the pose is off by more than 1 m or 0.5 rad.
        verdict: "tracking"; "uncertain", for a wide covariance or p_lost above 0.1; or "lost", if readings contradict
            the pose and p_lost is above 0.5.
        explained: Agreeing share of the explainable beams at the pose; NaN without any.
        covariance: (3, 3) covariance of the pose; None if the localiser states none.
        widening: Factor of the spread in :meth:`protection_level`.
        margin: Length added to the radius there [m].
        distances: Distances of poses around a pose without a covariance, by the likelihood of its scan.

    Example:
        >>> import gpusense as gs
        >>> gs.PoseVerdict(0.7, "lost", 0.2).lost
        True
    """

    p_lost: float
    verdict: Word
    explained: float
    covariance: np.ndarray | None = field(default=None, repr=False, compare=False)
    widening: float = field(default=1.0, repr=False)
    margin: float = field(default=0.0, repr=False)
    distances: Distances | None = field(default=None, repr=False, compare=False)


class PoseMonitor:
    """Judge a localiser's poses by successive scans.

    Poses may come from AMCL, a pose graph or motion capture. Each call adds a scan to a persistent belief
    (``docs/localization.md``), so pass the scans in order. Unlike a filter it does not compare the pose with other
    places of the map; on a coarse map it therefore reports "lost" more often.

    Args:
        models: A model of scans or landmarks with the map, or several models of a device.
        seed: Seed of the random poses for comparing features.

    Raises:
        TypeError: An object is no such model.
        ValueError: There is no model, models have several devices, or none has a map.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> room = np.pad(np.zeros((50, 80), int), 1, constant_values=100)
        >>> scanner = gs.Scanner.uniform(angle_min=-3.1, angle_increment=0.2, count=32, range_max=10.0)
        >>> model = gs.BeamModel(gs.OccupancyGrid(room, 0.1), scanner, gs.BeamParameters(), backend="numpy")
        >>> monitor, pose = gs.PoseMonitor(model), np.array([2.0, 3.0, 0.5])
        >>> monitor.update(pose, model.expected_ranges(pose[None])[0]).verdict
        'tracking'
    """

    def __init__(self, models: Any, *, seed: int = 0) -> None:
        self._sensors = sensors_of(models)
        self._seed = checks.integer("seed", seed, low=0, high=(1 << 64) - 1)
        self._verdict = Verdict(self._sensors, self._random_poses, seed=self._seed)
        if not self._verdict.informed:
            raise ValueError("models: must have a map of walls or landmarks, got none that has")
        self._pose: np.ndarray | None = None
        self._last: dict[int, tuple[Any, ...]] = {}

    def __repr__(self) -> str:
        names = ", ".join(type(sensor.model).__name__ for sensor in self._sensors)
        return f"PoseMonitor([{names}], scans={self._verdict.state.corrections}, wrong={self._verdict.wrong:.2g})"

    def update(self, pose: AnyArray, ranges: Any, covariance: AnyArray | None = None) -> PoseVerdict:
        """Judge a pose by its readings.

        Args:
            pose: (3,) x, y, theta [m, m, rad].
            ranges: (K,) readings of the only model, or a mapping from models to their readings; for landmarks a tuple
                ``(features,)``. None, and a scan without a reading, give no evidence.
            covariance: (3, 3) covariance of the pose, which may be infinite; None if the localiser states none.

        Raises:
            TypeError, ValueError: an argument breaks its rule.
        """
        # Copies, since the caller may reuse the arrays before the verdict and diagnose read them.
        place = checks.array("pose", pose, (3,)).copy()
        spread = np.zeros((3, 3)) if covariance is None else _checked(covariance).copy()
        readings = dict(readings_of(ranges, self._sensors))
        for index, reading in readings.items():
            if self._sensors[index].calibrates:
                scanner = self._sensors[index].model.scanner
                values = checks.array("ranges", reading[0], (scanner.count,), finite=False, dtype=None)
                readings[index] = (float64_readings(values, scanner), *reading[1:])
        self._verdict.corrected()
        if self._verdict.watches(readings):
            drawn = starts.normal(place, _finite(spread), _DRAWN, (self._seed & 0xFFFFFFFF, self._seed >> 32, 0))
            self._verdict.predicted(drawn, np.full(_DRAWN, 1 / _DRAWN), readings)
        explained = self._verdict.judge(place, spread, readings)
        self._pose, self._last = place, readings
        wrong = self._verdict.wrong
        p_lost, beyond = wrong + (1 - wrong) * share_off(spread), spread_of(spread)
        word = verdict_label(p_lost, wrong, wide=beyond.wide, apart=beyond.apart)
        states_none = covariance is None
        distances = distances_by_scan(self._sensors, readings, place) if states_none else None
        stated = None if states_none else spread
        return PoseVerdict(p_lost, word, explained, stated, *margins_of(self._sensors), distances)

    @property
    def state(self) -> VerdictState:
        """The monitor's memory of the scans: an immutable value that can be stored and assigned again."""
        return self._verdict.state

    @state.setter
    def state(self, state: VerdictState) -> None:
        if not isinstance(state, VerdictState):
            raise TypeError(f"state: must be that of a PoseMonitor, got {checks.show(state)}")
        self._verdict.state = state

    def reset(self) -> None:
        """Forget all scans, for example after the localiser was set to a new pose."""
        self._verdict.reset()
        self._pose, self._last = None, {}

    def diagnose(self, *, search: bool = True) -> Diagnosis:
        """Return the evidence of the last readings at the last pose, and the likely cause of a contradiction.

        Args:
            search: Whether to search for a better pose elsewhere on the map, which takes a few milliseconds.

        Raises:
            RuntimeError: no pose was judged yet.
        """
        checks.boolean("search", search)
        if self._pose is None:
            raise RuntimeError("diagnose: needs an update first")
        search = search and any(hasattr(sensor.model, "grid") for sensor in self._sensors)
        return diagnose(self._sensors, self._last, self._pose, self._random_poses if search else None)

    def _random_poses(self, count: int) -> np.ndarray:
        pool, spread = starts.free_pool([sensor.model for sensor in self._sensors], None)
        return starts.spread(pool, spread, count, (self._seed & 0xFFFFFFFF, self._seed >> 32, 1))


def _checked(covariance: AnyArray) -> np.ndarray:
    """Return a covariance."""
    matrix = checks.array("covariance", covariance, (3, 3), finite=False)
    if np.isnan(matrix).any():
        raise ValueError("covariance: must have no NaN, got one that has")
    finite = np.where(np.isfinite(matrix), matrix, 0.0)
    if np.abs(finite - finite.T).max() > 1e-6 * max(np.abs(finite).max(), 1e-300):
        raise ValueError("covariance: must be symmetric, got one that is not")
    if (np.diag(matrix) < 0).any():
        raise ValueError(f"covariance: must have variances >= 0, got {float(np.diag(matrix).min())}")
    return matrix


def _finite(covariance: np.ndarray) -> np.ndarray:
    """Return a covariance for drawing poses."""
    if np.isfinite(covariance).all():
        values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
        return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)
    return np.diag([1.0, 1.0, math.pi / 4])
