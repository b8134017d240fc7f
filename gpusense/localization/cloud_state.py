"""Plain data of a filter's particles: arguments of a step, state of a correction, copies on the host."""

from __future__ import annotations

import math
import threading
from typing import Any, NamedTuple

import numpy as np

from gpusense.interface import constants as c
from gpusense.reference.weighing import left_of

# Lowest depth of a ladder: distances of a million deviations differ by 2^-39 on its last rung.
_DEEPEST = c.LOWEST**5
# Effective sample size below which a stage repeats its weighing on a deeper ladder.
_FEWEST = 10.0
# Jitter of a stage on a deeper ladder: the peak is beyond the particles, which must not contract before reaching it.
_WIDE_JITTER = 0.7


class Contents(NamedTuple):
    """Particles on the host."""

    poses: np.ndarray  # (N, 3) shown poses
    weights: np.ndarray  # (N,) their unnormalised weights
    next_poses: np.ndarray | None  # (M, 3) poses of the next step; None if the shown poses were not weighed
    next_weights: np.ndarray | None  # (M,) weights at the beginning of the next step; None if ``next_poses`` is None
    state: np.ndarray  # state of the last correction in the kernels' layout
    pool: np.ndarray | None  # poses for recovery to inject, or None


class Snapshot:
    """Particles of one moment, copied to the host when they are asked for, or before a step overwrites them."""

    def __init__(self, cloud: Any, count: int) -> None:
        self.places, self._count, self._lock = cloud.places, count, threading.Lock()
        self._cloud: Any = cloud
        self._copies: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def is_on_device(self) -> bool:
        """Return whether the particles have not been copied yet."""
        return self._copies is None

    def __call__(self) -> tuple[np.ndarray, np.ndarray]:
        """Return (N, 3) poses and (N,) unnormalised weights."""
        with self._lock:
            if self._copies is None and (cloud := self._cloud) is not None:
                poses = cloud.host_poses(self.places.shown, self._count)
                self._copies, self._cloud = (poses, cloud.host_weights(self._count, self.places.weight)), None
        assert self._copies is not None
        return self._copies


class Summary(NamedTuple):
    """The state of a filter after a correction."""

    effective_sample_size: float  # effective sample size of the last stage, at most the number of distinct particles
    temperature: float  # share of the temperature used by all stages
    degenerate: bool  # whether no particle was possible
    stages: int  # number of stages that ran
    numbers: np.ndarray  # the state in the kernels' layout
    resampled: bool  # whether particles were drawn at the end

    @property
    def evidence(self) -> float:
        """Log p(z | earlier readings); -inf if no particle was possible."""
        return -math.inf if self.degenerate else float(self.numbers[c.EVIDENCE])


def summary_of(numbers: np.ndarray) -> Summary:
    """Return the summary of a state in the kernels' layout."""
    used, stage, distinct = 0.0, 0, math.inf
    while True:
        own = numbers[stage * c.STAGE : (stage + 1) * c.STAGE]
        used += float(own[c.RUNG])
        if own[c.LEFT] == 0.0:
            break
        # The difference of two other parents jitters each copy, so that m parents have at most m^3 distinct copies.
        distinct = min(distinct, float(own[c.SAMPLE_SIZE]) ** 3)
        stage += 1
    size = min(float(own[c.SAMPLE_SIZE]), distinct)
    return Summary(size, min(used, 1.0), bool(numbers[c.DEGENERATE]), stage + 1, numbers, bool(own[c.RESAMPLED]))


def is_starved(numbers: np.ndarray, settings: np.ndarray, stage: int, count: int) -> bool:
    """Return whether the tempering ladder is too shallow: its last rung leaves too few particles with weight."""
    own = numbers[stage * c.STAGE : (stage + 1) * c.STAGE]
    if not own[c.SAMPLE_SIZE] < min(settings[c.SHARE] * count, _FEWEST):
        return False
    lowest = left_of(numbers, stage) * settings[c.DEPTH] * c.LOWEST
    return bool(own[c.RUNG] == lowest > 0.0 and not own[c.DEGENERATE] and settings[c.DEPTH] > _DEEPEST)


def deeper(settings: np.ndarray) -> np.ndarray:
    """Return the settings of a step with a ladder below the last rung of the present one."""
    result = settings.copy()
    result[c.DEPTH] *= c.LOWEST
    result[c.JITTER], result[c.FARTHEST_X], result[c.FARTHEST_THETA] = _WIDE_JITTER, math.inf, math.pi
    return result


def meaningful(numbers: np.ndarray, averages: bool) -> np.ndarray:
    """Clear unused numbers of a state: stages that did not run, and averages that recovery does not follow."""
    end, result = summary_of(numbers).stages * c.STAGE, np.zeros(c.STATE)
    result[:end] = numbers[:end]
    if averages:
        result[c.EVIDENCE : c.INJECTED + 1] = numbers[c.EVIDENCE : c.INJECTED + 1]
    return result
