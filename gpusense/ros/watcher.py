"""Judge a localiser without ROS, behind the watching node: from map, scans and poses to diagnostics.

nav2_amcl stamps a pose with its scan's time, so both are paired by time.
"""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import Any

import numpy as np

from gpusense.evaluation.tracking import RISK
from gpusense.localization.diagnosis import Diagnosis
from gpusense.localization.monitor import PoseMonitor, PoseVerdict
from gpusense.models.scan.field import LikelihoodFieldModel
from gpusense.ros.conversions import LEVELS, STALE, CommonBeams, laser_scan, start_of, status_fields
from gpusense.ros.pacing import Rest
from gpusense.world.grid import OccupancyGrid
from gpusense.world.messages import stamp_of
from gpusense.world.scanner import Scanner

# Most scans that wait for their pose.
_KEPT = 40
# Number of last diagnoses for the most frequent cause.
_CAUSES = 7


class Watcher:
    """Verdict on another localiser's poses in ``frame``, stale after ``patience`` seconds without a judged pose.

    Times of a pose and its scan differ by at most ``tolerance`` [s], and ``range_max`` [m] limits scans. ``risk`` is
    the probability that the error of the position exceeds the published radius, ``problem`` the reason why the last
    scan was unusable.
    """

    def __init__(
        self,
        *,
        backend: str = "auto",
        tolerance: float = 0.05,
        patience: float = 10.0,
        frame: str = "map",
        range_max: float = 100.0,
        risk: float = RISK,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.backend, self.tolerance, self.patience, self.frame = backend, tolerance, patience, frame
        self.range_max, self.risk = range_max, risk
        self.problem: str | None = None
        self._grid: OccupancyGrid | None = None
        self._monitor: PoseMonitor | None = None
        self._scanner: Scanner | None = None
        self._beams = CommonBeams()
        self._scans: deque[tuple[float, Scanner, np.ndarray]] = deque(maxlen=_KEPT)
        self._verdict: PoseVerdict | None = None
        self._causes: deque[Diagnosis] = deque(maxlen=_CAUSES)
        self._judged = -math.inf
        # The last pose without a scan of its time, which may arrive later.
        self._early: Any = None
        self._rest = Rest(clock)

    def set_map(self, grid: OccupancyGrid) -> None:
        """Take a map, and forget the scans so far; the map that it has changes nothing."""
        if grid != self._grid:
            self._grid, self._monitor = grid, None

    def reset(self) -> None:
        """Forget the scans so far, for example after an initial pose."""
        self._verdict = self._early = None
        self._causes.clear()
        if self._monitor is not None:
            self._monitor.reset()

    def add_scan(self, message: Any, laser: np.ndarray) -> bool:
        """Take a sensor_msgs/LaserScan and the (4, 4) pose of its laser; return whether a pose waited for it.

        ``problem`` tells why a scan is invalid.
        """
        try:
            scanner, fields = laser_scan(message, laser, (None, self.range_max))
            self.problem = None
        except (TypeError, ValueError) as error:
            self.problem = str(error)
            return False
        ranges = self._beams.take(scanner, fields)
        assert self._beams.scanner is not None
        self._scans.append((stamp_of("message", message), self._beams.scanner, ranges))
        return self._early is not None and self.add_pose(self._early)

    def add_pose(self, message: Any) -> bool:
        """Take a geometry_msgs/PoseWithCovarianceStamped; return whether there was a map, and a scan of its time."""
        pose, covariance = start_of(message, self.frame)
        stamp = stamp_of("message", message)
        nearest = min(self._scans, key=lambda scan: abs(scan[0] - stamp), default=None)
        if self._grid is None or nearest is None or abs(nearest[0] - stamp) > self.tolerance:
            self._early = message
            return False
        self._early = None
        _, scanner, ranges = nearest
        monitor = self._monitor_of(self._grid, scanner)
        self._verdict = monitor.update(pose, ranges, covariance)
        if self._verdict.verdict == "tracking":
            self._causes.clear()
        elif self._rest.over:
            with self._rest.after():
                self._causes.append(monitor.diagnose())
        self._judged = stamp
        return True

    def status(self, now: float, node: str = "gpusense") -> dict[str, Any]:
        """Return the fields of diagnostic_msgs/DiagnosticStatus at a time [s]."""
        # A restarted recording turns the clock back.
        if self._verdict is None or abs(now - self._judged) > self.patience:
            return status_fields("localisation", STALE, "no pose with a scan of its time", {}, node)
        found, likely = self._verdict, None
        if self._causes:
            # The newest of the last diagnoses with the most frequent cause.
            ((cause, _),) = Counter(each.cause for each in self._causes).most_common(1)
            likely = next(each for each in reversed(self._causes) if each.cause == cause)
        evidence = "" if likely is None else f": {likely.text}"
        values = {
            "p_lost": f"{found.p_lost:.4f}", "verdict": found.verdict, "explained": f"{found.explained:.3f}",
            "radius": f"{found.protection_level(self.risk):.3f}", "risk": f"{self.risk:g}",
        }  # fmt: skip
        if likely is not None:
            values["cause"] = likely.cause
        return status_fields("localisation", LEVELS[found.verdict], f"{found.verdict}{evidence}", values, node)

    def _monitor_of(self, grid: OccupancyGrid, scanner: Scanner) -> PoseMonitor:
        """Return the monitor of a scanner; its memory survives a change of scanners."""
        if self._monitor is None or scanner is not self._scanner:
            before = self._monitor
            self._monitor = PoseMonitor(LikelihoodFieldModel(grid, scanner, backend=self.backend))
            self._scanner = scanner
            if before is not None:
                self._monitor.state = before.state
        return self._monitor
