"""The monitor behind the watching node, without ROS: map, scans and poses in; diagnostics out.

nav2_amcl stamps a pose with the time of the scan that it comes from, so the two are paired by their times.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np

import gpusense as gs
from gpusense_localization.conversions import Pose, covariance_of, pose_of
from gpusense_localization.diagnostics import LEVELS, STALE, status_fields

# Scans that wait for their pose.
_KEPT = 40


def seconds_of(stamp: Any) -> float:
    """Return the time of builtin_interfaces/Time [s]."""
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


class Watcher:
    """A verdict on the poses of another localiser.

    Args:
        backend: The device.
        tolerance: Largest difference of the times of a pose and its scan [s].
        patience: Time without a judged pose after which the verdict is stale [s].

    Attributes:
        problem: Why the last scan could not be used; None where it could.
    """

    def __init__(self, *, backend: str = "auto", tolerance: float = 0.05, patience: float = 10.0) -> None:
        self.backend, self.tolerance, self.patience = backend, tolerance, patience
        self.problem: str | None = None
        self._grid: gs.OccupancyGrid | None = None
        self._monitor: gs.PoseMonitor | None = None
        self._scanner: gs.Scanner | None = None
        self._scans: deque[tuple[float, gs.Scanner, np.ndarray]] = deque(maxlen=_KEPT)
        self._verdict: gs.PoseVerdict | None = None
        self._diagnosis: gs.Diagnosis | None = None
        self._judged = -math.inf

    def set_map(self, message: Any) -> None:
        """Take a nav_msgs/OccupancyGrid; what was known of the pose is forgotten."""
        self._grid, self._monitor = gs.OccupancyGrid.from_message(message), None

    def reset(self) -> None:
        """Forget the scans so far, as after an initial pose."""
        self._verdict = self._diagnosis = None
        if self._monitor is not None:
            self._monitor.reset()

    def add_scan(self, message: Any, mount: Pose) -> None:
        """Take a sensor_msgs/LaserScan, and the pose of its laser on the robot.

        A scan that breaks a rule, as with a range_max of infinity, is left out, and ``problem`` says why.
        """
        try:
            scanner, self.problem = gs.Scanner.from_laser_scan(message, mount), None
        except ValueError as error:
            self.problem = str(error)
            return
        self._scans.append((seconds_of(message.header.stamp), scanner, np.array(message.ranges, np.float64)))

    def add_pose(self, message: Any) -> bool:
        """Take a geometry_msgs/PoseWithCovarianceStamped; return whether there was a map, and a scan of its time."""
        time = seconds_of(message.header.stamp)
        nearest = min(self._scans, key=lambda scan: abs(scan[0] - time), default=None)
        if self._grid is None or nearest is None or abs(nearest[0] - time) > self.tolerance:
            return False
        _, scanner, ranges = nearest
        monitor = self._monitor_of(scanner)
        self._verdict = monitor.update(pose_of(message.pose.pose), ranges, covariance_of(message.pose.covariance))
        self._diagnosis = None if self._verdict.verdict == "tracking" else monitor.diagnose()
        self._judged = time
        return True

    def status(self, now: float) -> dict[str, Any]:
        """Return the fields of diagnostic_msgs/DiagnosticStatus.

        Args:
            now: Time [s].
        """
        if self._verdict is None or now - self._judged > self.patience:
            return status_fields("localisation", STALE, "no pose with a scan of its time", {})
        found = self._verdict
        evidence = "" if self._diagnosis is None else f": {self._diagnosis.text}"
        values = {"p_lost": f"{found.p_lost:.4f}", "verdict": found.verdict, "explained": f"{found.explained:.3f}"}
        if self._diagnosis is not None:
            values["cause"] = self._diagnosis.cause
        return status_fields("localisation", LEVELS[found.verdict], f"{found.verdict}{evidence}", values)

    def _monitor_of(self, scanner: gs.Scanner) -> gs.PoseMonitor:
        """Return the monitor of a scanner; what it remembers stays where the scanner changes."""
        if self._monitor is None or scanner != self._scanner:
            model = gs.LikelihoodFieldModel(self._grid, scanner, backend=self.backend)
            before, self._monitor, self._scanner = self._monitor, gs.PoseMonitor(model), scanner
            if before is not None:
                self._monitor.state = before.state
        return self._monitor
