"""Whether a filter is lost: how many beams of recent scans the estimated pose explains.

A beam is explained if its log-likelihood at the estimate is nearer to a good one than to a poor one. Poor is the median
of the beams of the scan at random poses in the free space, good the 99th percentile there: a random pose meets the
right range by chance now and then. The share that a filter on the right map explains is near 1, even among people. A
filter on a wrong map fits some walls and explains about half.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from gpusense.localization.sensors import Sensor

# Random poses; corrections over which the share is averaged; the least share of a filter that is not lost.
_RANDOM, _MEMORY, LEAST_EXPLAINED = 64, 5, 0.8


class Verdict:
    """Running share of explained beams.

    Args:
        sensors: The filter's sensors.
        random_poses: Returns poses anywhere in the free space.

    Attributes:
        corrections: Corrections since the filter began.
    """

    def __init__(self, sensors: Sequence[Sensor], random_poses: Callable[[int], np.ndarray]) -> None:
        self._sensors, self._random_poses = sensors, random_poses
        self._poses: np.ndarray | None = None
        self.reset()

    def reset(self) -> None:
        """Forget all scans."""
        self.corrections, self._judged, self._share = 0, 0, math.nan
        self._last = math.nan

    def corrected(self) -> None:
        """Count a correction."""
        self.corrections += 1

    @property
    def due(self) -> bool:
        """Tell whether enough corrections have passed for a new judgement."""
        return self.corrections % _MEMORY == 0

    @property
    def lost(self) -> bool:
        """Tell whether recent scans contradict the pose; False before any was judged."""
        return self._share < LEAST_EXPLAINED

    def explained(self, pose: np.ndarray, readings: Mapping[int, tuple[Any, ...]]) -> float:
        """Return the share of the beams of the last scans that a pose explains; NaN where no reading has beams."""
        if self._judged == self.corrections:
            return self._last
        if self._poses is None:
            self._poses = self._random_poses(_RANDOM)
        shares = []
        for index, reading in readings.items():
            if self._sensors[index].calibrates:
                parts = self._sensors[index].parts(np.vstack([pose[None], self._poses]), reading)
                shares.append(explained_share(parts[0], parts[1:]))
        self._judged = self.corrections
        self._last = float(np.mean(shares)) if shares else math.nan
        if not math.isnan(self._last):
            rate = 1 / min(self.corrections, _MEMORY) if self.corrections else 1.0
            self._share = self._last if math.isnan(self._share) else self._share + rate * (self._last - self._share)
        return self._last


def explained_share(at: np.ndarray, elsewhere: np.ndarray) -> float:
    """Return the share of beams that are explained; NaN without beams."""
    used = np.isfinite(at) & (at != 0)
    values = elsewhere[:, used]
    values = values[np.isfinite(values)]
    if not used.any() or not values.size:
        return math.nan
    poor, good = np.percentile(values, (50, 99))
    if not good > poor:
        return 1.0
    return float(np.mean(at[used] > (poor + good) / 2))
