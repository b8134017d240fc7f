"""The localiser behind the node, without ROS: map, scans and odometry in; estimate, cloud and transform out."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.world.messages import spread_readings
from gpusense_localization.conversions import Pose, host_array, map_to_odometry, moved_enough
from gpusense_localization.diagnostics import ERROR, LEVELS, STALE, WARN, status_fields

# Beams of the scanner of scans whose beams vary.
PLACES = 1440
# Time without a scan after which diagnostics are stale [s].
_PATIENCE = 5.0


class Localizer:
    """A particle filter that is made as soon as map, scanner and first pose are known.

    Args:
        options: Options of nav2_amcl, see ``gpusense.compat.from_nav2``.
        backend: The device.
        seed: Seed of the filter.
        clock: Returns the time [s].

    Attributes:
        estimate: Estimate of the last scan that counted; None before one, and after a new start.
        problem: Why the last scan could not be used; None where it could.
        counted: Number of scans that counted.
    """

    def __init__(
        self,
        options: gs.compat.Nav2Options,
        *,
        backend: str = "auto",
        seed: int = 0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.options, self._clock = options, clock
        self.backend, self.seed = backend, seed
        self.grid: gs.OccupancyGrid | None = None
        self.filter: Any = None
        self._scanner: gs.Scanner | None = None
        self._spread = False
        self.estimate: Any = None
        self.counted = 0
        self._cause = ""
        self._taken = -math.inf
        self.problem: str | None = None
        self._last: Pose | None = None
        self._start: tuple[np.ndarray, np.ndarray] | None = None
        if options.initial_pose is not None:
            covariance = options.initial_covariance or np.diag([0.25, 0.25, (math.pi / 12) ** 2])
            self.start_at(options.initial_pose, np.asarray(covariance))

    def set_map(self, message: Any) -> None:
        """Take a nav_msgs/OccupancyGrid; a filter goes on around its last estimate."""
        self.grid = gs.OccupancyGrid.from_message(message)
        if self.filter is not None:
            self._make(self._scanner)

    def start_at(self, pose: Pose, covariance: np.ndarray) -> None:
        """Begin around a pose."""
        self._start, self._last, self.estimate = (np.array(pose), np.asarray(covariance)), None, None
        if self.filter is not None:
            self.filter.initialize(mean=self._start[0], covariance=self._start[1])

    def start_anywhere(self) -> None:
        """Begin all over the map, as nav2_amcl's ``reinitialize_global_localization`` does."""
        self._start = self._last = self.estimate = None
        if self.filter is not None:
            self.filter.initialize_uniform()

    def update(self, message: Any, odometry: Pose, mount: Pose) -> bool:
        """Take a sensor_msgs/LaserScan at an odometry pose; return whether it counted.

        As in nav2_amcl, a scan counts if there is a map and the robot has moved enough since the last one that did. One
        that breaks a rule, as with a range_max of infinity, does not count, and ``problem`` says why.
        """
        if self.grid is None:
            return False
        try:
            scanner, self.problem = gs.Scanner.from_laser_scan(message, mount), None
        except ValueError as error:
            self.problem = str(error)
            return False
        self._taken = self._clock()
        ranges = self._readings(message, scanner)
        if self._last is not None and not moved_enough(self._last, odometry, self.options.update_min):
            return False
        if self._last is not None:
            self.filter.predict(np.array(self._last), np.array(odometry))
        self.filter.correct(ranges)
        self._last, self.estimate = odometry, self.filter.estimate()
        self.counted, self._cause = self.counted + 1, ""
        return True

    def map_to_odometry(self) -> Pose:
        """Return the pose of the odometry frame in the map, by the last scan that counted."""
        x, y, yaw = (float(value) for value in self.estimate.pose)
        return map_to_odometry((x, y, yaw), self._last)

    def cloud(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the (N, 3) particles and their (N,) weights."""
        return host_array(self.filter.particles), host_array(self.filter.weights)

    def status(self, dropped: int = 0, reason: str | None = None) -> dict[str, Any]:
        """Return the fields of diagnostic_msgs/DiagnosticStatus.

        Args:
            dropped: Number of scans whose transforms did not come.
            reason: Why the last of them did not.
        """
        values = {"scans that counted": str(self.counted), "scans without transforms": str(dropped)}
        if self.grid is None:
            return status_fields("filter", WARN, "no map yet", values)
        if self.problem is not None:
            return status_fields("filter", ERROR, f"scans cannot be used: {self.problem}", values)
        if self._clock() - self._taken > _PATIENCE:
            why = "" if reason is None else f": {reason}"
            return status_fields("filter", STALE, f"no scan for {_PATIENCE:g} s{why}", values)
        found = self.estimate
        if found is None:
            return status_fields("filter", WARN, "no estimate since the start", values)
        values |= {
            "verdict": found.verdict, "p_lost": f"{found.p_lost:.4f}", "explained": f"{found.explained:.3f}",
            "particles": str(found.particles), "effective sample size": f"{found.effective_sample_size:.0f}",
        }  # fmt: skip
        # The search for a cause takes milliseconds, so it is made once for an estimate.
        if found.verdict != "tracking" and not self._cause:
            self._cause = self.filter.diagnose().text
        return status_fields(
            "filter", LEVELS[found.verdict], ": ".join(filter(None, (found.verdict, self._cause))), values
        )

    def _readings(self, message: Any, scanner: gs.Scanner) -> np.ndarray:
        """Return the readings for the filter's scanner; make the filter where there is none for it.

        The first scan's geometry is the scanner. Once a scan has another one, all are spread on common bearings, so
        that a laser whose beams vary needs a second model only.
        """
        if self.filter is None:
            self._spread = False
            self._make(scanner)
        elif scanner != self._scanner and not self._spread:
            self._spread = True
            self._make(gs.Scanner.uniform(
                angle_min=-math.pi, angle_increment=2 * math.pi / PLACES, count=PLACES, range_max=scanner.range_max,
                range_min=scanner.range_min, mount=scanner.mount,
            ))  # fmt: skip
        return spread_readings(message, PLACES) if self._spread else np.array(message.ranges, np.float64)

    def _make(self, scanner: gs.Scanner) -> None:
        model = self.options.make_model(self.grid, scanner, backend=self.backend)
        before, self.filter = self.filter, self.options.make_filter(model, seed=self.seed)
        self._scanner = scanner
        if before is not None and self.estimate is not None:
            estimate = before.estimate()
            self.filter.initialize(mean=estimate.pose, covariance=estimate.covariance)
        elif self._start is not None:
            self.filter.initialize(mean=self._start[0], covariance=self._start[1])
        else:
            self.filter.initialize_uniform()
