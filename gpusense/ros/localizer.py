"""Localise without ROS, behind the node: estimate pose, cloud and transform from scans."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from gpusense.evaluation.tracking import RISK
from gpusense.localization.nav2 import Nav2Options
from gpusense.localization.run_causes import CAUSES_OF_RUNS, diagnose_run
from gpusense.localization.scan_motion import Moment
from gpusense.logs.records import Pose
from gpusense.ros.conversions import (
    ERROR,
    LEVELS,
    STALE,
    WARN,
    CommonBeams,
    host_array,
    laser_scan,
    map_to_odometry,
    moved_enough,
    status_fields,
)
from gpusense.ros.pacing import Rest
from gpusense.world.grid import OccupancyGrid
from gpusense.world.messages import stamp_of
from gpusense.world.scanner import Scanner

# Time without a scan after which diagnostics are stale [s].
_PATIENCE = 5.0
# Scans that the likely cause is looked for in.
_HISTORY = 150
# Made-up scans for the first compilation of this search.
_WARM = 12
# Standard deviations of a first pose, as in nav2_amcl [m, m, rad].
_START = (0.5, 0.5, math.pi / 12)


class Localizer:
    """Particle filter that starts as soon as map, scanner and first pose are known.

    ``risk`` is the probability that the error of the position exceeds the published radius. ``estimate`` belongs to the
    last used scan, ``problem`` is the reason why the last scan was unusable, and ``counted`` the number of used scans.
    """

    def __init__(
        self,
        options: Nav2Options,
        *,
        backend: str = "auto",
        seed: int = 0,
        risk: float = RISK,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.options, self._clock = options, clock
        self.backend, self.seed, self.risk = backend, seed, risk
        self.grid: OccupancyGrid | None = None
        self.filter: Any = None
        self._scanner: Scanner | None = None
        self._beams = CommonBeams()
        self.estimate: Any = None
        self.counted = 0
        # The last search for the likely cause: number and verdict of its estimate, and its text.
        self._cause: tuple[int, str, str] | None = None
        self._rest = Rest(clock)
        self._history: deque[Moment] = deque(maxlen=_HISTORY)
        self._taken = clock()
        self.problem: str | None = None
        self._last: Pose | None = None
        self._start: tuple[np.ndarray, np.ndarray] | None = None
        if options.initial_pose is not None:
            covariance = options.initial_covariance or np.diag(np.square(_START))
            self.start_at(options.initial_pose, np.asarray(covariance))

    def warm_up(self) -> None:
        """Open the device, and compile the code for scans and causes on the map or a made-up room."""
        cells = np.zeros((80, 80), np.int8)
        cells[[0, -1]] = cells[:, [0, -1]] = 100
        grid = OccupancyGrid(cells, 0.1) if self.grid is None else self.grid
        scanner = Scanner.uniform(angle_min=-math.pi, angle_increment=math.pi / 180, count=360, range_max=10.0)
        made = self.options.make_filter(self.options.make_model(grid, scanner, backend=self.backend), seed=self.seed)
        if _is_reference(made):
            return
        for start in range(2):
            if start == 0:
                made.initialize_uniform()
            else:
                made.initialize(mean=(4.0, 4.0, 0.0), covariance=np.diag(np.square(_START)))
            # Scans that fit the middle of the room, and scans that fit nowhere.
            for step, distance in enumerate((4.0, 4.0, 0.5)):
                made.correct(np.full(360, distance))
                made.estimate()
                made.diagnose()
                made.predict((0.1 * step, 0.0, 0.0), (0.1 * (step + 1), 0.0, 0.0))
        poses = [(0.3 * k, 0.0, 0.0) for k in range(_WARM)]
        moments = [Moment(np.full(360, 4.0), pose, pose, float(k)) for k, pose in enumerate(poses)]
        self._likely_cause(made, moments)

    def begin(self) -> None:
        """Count the time without scans from now on."""
        self._taken = self._clock()

    def set_map(self, grid: OccupancyGrid) -> None:
        """Take a map; a filter continues with its particles, and the map that it has changes nothing."""
        before, self.grid = self.grid, grid
        if self.filter is None or grid == before:
            return
        try:
            self._make(self._scanner)
        except Exception:
            self.grid = before
            raise

    def start_at(self, pose: Pose, covariance: np.ndarray) -> None:
        """Begin around a pose."""
        self._start = np.array(pose), np.asarray(covariance)
        self.start_again()

    def start_anywhere(self) -> None:
        """Begin all over the map, like nav2_amcl's ``reinitialize_global_localization``."""
        self._start = None
        self.start_again()

    def start_again(self) -> None:
        """Repeat the last start: around a pose, or all over the map."""
        self._last = self.estimate = self._cause = None
        self._history.clear()
        if self.filter is not None:
            self._initialize(self.filter)

    def update(self, message: Any, odometry: Pose, laser: np.ndarray) -> bool:
        """Take a LaserScan with the robot's odometry and the laser's (4, 4) pose; return whether it is used.

        As in nav2_amcl, a scan is used if a map exists and the robot has moved enough since the last used scan. An
        invalid scan is not used, and ``problem`` states the reason.
        """
        if self.grid is None:
            return False
        try:
            scanner, fields = laser_scan(message, laser, self.options.range_limits)
            stamp = stamp_of("scan", message)
            self.problem = None
        except (TypeError, ValueError) as error:
            self.problem = str(error)
            return False
        self._taken = self._clock()
        ranges = self._beams.take(scanner, fields)
        if self._beams.scanner is not self._scanner:
            self._make(self._beams.scanner)
        if self._last is not None and not moved_enough(self._last, odometry, self.options.update_min):
            return False
        if self._last is not None:
            self.filter.predict(np.array(self._last), np.array(odometry))
        self.filter.correct(ranges)
        self._last, self.estimate = odometry, self.filter.estimate()
        self._history.append(Moment(ranges, self.estimate.pose, odometry, stamp))
        self.counted += 1
        return True

    def map_to_odometry(self) -> Pose:
        """Return the pose of the odometry frame in the map, by the last used scan."""
        if self._last is None:
            raise ValueError("no scan counted since the start")
        x, y, yaw = (float(value) for value in self.estimate.pose)
        return map_to_odometry((x, y, yaw), self._last)

    def cloud(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the (N, 3) particles and their (N,) weights."""
        return host_array(self.filter.particles), host_array(self.filter.weights)

    def status(self, counts: Mapping[str, int], reason: str | None = None, node: str = "gpusense") -> dict[str, Any]:
        """Return the fields of diagnostic_msgs/DiagnosticStatus; ``reason`` explains missing transforms or map."""
        values = {"scans that counted": str(self.counted)} | {f"scans {key}": str(n) for key, n in counts.items()}
        why = "" if reason is None else f": {reason}"
        if self.grid is None:
            return status_fields("filter", WARN, f"no map yet{why}", values, node)
        if self.problem is not None:
            return status_fields("filter", ERROR, f"scans cannot be used: {self.problem}", values, node)
        if self._clock() - self._taken > _PATIENCE:
            return status_fields("filter", STALE, f"no scan for {_PATIENCE:g} s{why}", values, node)
        found = self.estimate
        if found is None:
            return status_fields("filter", WARN, f"no estimate since the start{why}", values, node)
        values |= {
            "verdict": found.verdict, "p_lost": f"{found.p_lost:.4f}", "explained": f"{found.explained:.3f}",
            "particles": str(found.particles), "effective sample size": f"{found.effective_sample_size:.0f}",
            "radius": f"{found.protection_level(self.risk):.3f}", "risk": f"{self.risk:g}",
        }  # fmt: skip
        text = ": ".join(filter(None, (found.verdict, self._cause_of(found.verdict))))
        return status_fields("filter", LEVELS[found.verdict], text, values, node)

    def _cause_of(self, verdict: str) -> str | None:
        """Return the likely cause of a verdict; the search rests, and its text then stays while the verdict does."""
        if verdict == "tracking":
            return None
        if (self._cause is None or self._cause[0] != self.counted) and self._rest.over:
            with self._rest.after():
                self._cause = self.counted, verdict, self._likely_cause(self.filter, self._history)
        return self._cause[2] if self._cause is not None and self._cause[1] == verdict else None

    def _likely_cause(self, judged: Any, moments: Sequence[Moment]) -> str:
        """Return the likely cause by the last scan and, with kernels, by the motion between the scans of the run.

        The reference would match those scans for seconds.
        """
        if not _is_reference(judged):
            run = diagnose_run(judged.models, moments, search=False)
            if run.cause in CAUSES_OF_RUNS:
                return run.text
        return str(judged.diagnose().text)

    def _make(self, scanner: Scanner | None) -> None:
        """Make a filter for a scanner and the map, with the particles of the filter before it."""
        assert self.grid is not None and scanner is not None
        model = self.options.make_model(self.grid, scanner, backend=self.backend)
        made = self.options.make_filter(model, seed=self.seed)
        if self.filter is None or self.estimate is None:
            self._initialize(made)
        else:
            made.restore(self.filter.state())
        self.filter, self._scanner, self._cause = made, scanner, None
        self._history.clear()

    def _initialize(self, made: Any) -> None:
        if self._start is None:
            made.initialize_uniform()
        else:
            made.initialize(mean=self._start[0], covariance=self._start[1])


def _is_reference(made: Any) -> bool:
    """Return whether a filter runs by the NumPy reference, which compiles nothing."""
    return bool(made.models[0].device.selection == "numpy")
