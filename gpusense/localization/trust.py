"""Trust in the pose that a start anywhere on the map has found.

Such a start may end at a wrong place: another place may look alike, or the map may have changed where the robot begins.
So a converged pose is trusted as far as the robot has moved with it while the scans agreed. Where they contradict it,
trust falls as the robot moves, and without trust the search is repeated.
"""

from __future__ import annotations

import math

import numpy as np

from gpusense.localization.estimates import Estimate

# A judgement counts where the pose has moved this far since the last one [m, rad]; most judgements that are remembered.
_MOVED, _TURNED, _MOST = 0.3, 0.3, 10
# Deviation of the particles above which they have no common pose yet [m].
_APART = 1.0
# Least share of the beams that a trusted pose explains.
_EXPLAINED = 0.6


class Trust:
    """Judgements of a pose in favour of it, less those against it."""

    def __init__(self) -> None:
        self._count = 0
        self._last: np.ndarray | None = None

    def contradicted(self, estimate: Estimate) -> bool:
        """Take a judgement into account, and tell whether the search is to be repeated."""
        if math.sqrt(estimate.covariance[0, 0] + estimate.covariance[1, 1]) > _APART:
            return False
        dx, dy, turn = (math.inf, 0.0, 0.0) if self._last is None else estimate.pose - self._last
        moved = math.hypot(dx, dy) > _MOVED or abs(math.remainder(turn, math.tau)) > _TURNED
        if moved:
            self._last = estimate.pose
        # Beams that are only too short do not make a pose lost, but a place that was searched for should explain more.
        against = estimate.verdict != "tracking" or estimate.explained < _EXPLAINED
        if against and not self._count:
            return True
        self._count = min(self._count + (-moved if against else moved), _MOST)
        return False
