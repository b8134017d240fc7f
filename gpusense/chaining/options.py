"""Define the options of a chain of scans, and check its arguments."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks
from gpusense._util.typing import Floats, Precision
from gpusense.backends import Selection
from gpusense.localization.motion import OdometryMotion

# Least time gap of a jump, in usual steps and [s].
_JUMP_STEPS, _JUMP = 10.0, 2.0
# Longest time from the first beam of a scan to the last one [s].
_LONGEST = 3600.0


@dataclass(frozen=True)
class ChainOptions:
    """Options of a chain."""

    step: tuple[float, float]  # least motion by odometry of a matched scan [m, rad]
    duration: float  # time from the first beam of a scan to the last one [s]
    motion: OdometryMotion | None  # noise of the odometry; None to fit it to the matches
    close_loops: bool  # whether to search for revisited places
    backend: Selection = field(repr=False)
    precision: Precision  # precision of the matches


def check_step(value: object) -> tuple[float, float]:
    """Return a step in x and y [m], and a turn [rad]."""
    values = checks.array("step", value, (2,))
    length = checks.real("step[0]", float(values[0]), low=0.0, high=checks.FARTHEST)
    return length, checks.real("step[1]", float(values[1]), low=0.0, high=math.pi + 1e-9)


def check_times(times: object, scans: int) -> Floats | None:
    """Return the times of S scans."""
    if times is None:
        return None
    values: Floats = checks.array("times", times, (scans,))
    falls = np.flatnonzero(np.diff(values) < 0)
    if len(falls):
        k = int(falls[0]) + 1
        raise ValueError(f"times: must not decrease, got {values[k]} after {values[k - 1]} at scan {k}")
    return values


def check_durations(duration: object, scanners: int, timed: bool) -> tuple[float, ...]:
    """Return the times of scans of L scanners from the first beam to the last one [s]."""
    several = scanners > 1 and checks.as_array("duration", duration).ndim == 1
    given = checks.array("duration", duration, (scanners,)).tolist() if several else [duration] * scanners
    values = tuple(float(checks.real("duration", value, low=0.0, high=_LONGEST)) for value in given)
    if max(values) > 0 and not timed:
        raise ValueError(f"duration: must be 0 without times, got {duration}")
    return values


def jumps_of(times: Floats | None, scans: int) -> NDArray[np.bool]:
    """Return the mask (S,) of scans after a much longer time than usual; False for the first one."""
    jumps = np.zeros(scans, bool)
    if times is None or scans < 3:
        return jumps
    gaps = np.diff(times)
    usual = float(np.median(gaps[gaps > 0])) if (gaps > 0).any() else 0.0
    jumps[1:] = gaps > max(_JUMP_STEPS * usual, _JUMP)
    return jumps
