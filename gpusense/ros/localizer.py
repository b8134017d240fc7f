"""Localise without ROS, behind the node: queue scans, and estimate pose, cloud and transform from them."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from gpusense.evaluation.tracking import RISK
from gpusense.localization.nav2 import Nav2Options
from gpusense.localization.run_causes import CAUSES_OF_RUNS, diagnose_run
from gpusense.localization.scan_motion import Moment
from gpusense.logs.bag_beams import Beams, alike
from gpusense.logs.records import Pose
from gpusense.logs.transform_buffer import BACK, TransformError
from gpusense.ros.conversions import (
    ERROR,
    LEVELS,
    STALE,
    WARN,
    host_array,
    laser_scan,
    map_to_odometry,
    moved_enough,
    status_fields,
)
from gpusense.world.grid import OccupancyGrid
from gpusense.world.messages import laser_beams, stamp_of
from gpusense.world.scanner import Scanner

PLACES = 1440
"""Beams of the common scanner for varying beams."""
# Time without a scan after which diagnostics are stale [s].
_PATIENCE = 5.0
# Scans that the likely cause is looked for in.
_HISTORY = 150
# Least difference of distinct mounts [m, rad].
_SAME_MOUNT = 1e-3
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
        self._beams: Beams | None = None
        self.estimate: Any = None
        self.counted = 0
        # Text of the likely cause of the last estimate; None before the search.
        self._cause: str | None = None
        self._history: deque[Moment] = deque(maxlen=_HISTORY)
        self._taken = clock()
        self.problem: str | None = None
        self._last: Pose | None = None
        self._start: tuple[np.ndarray, np.ndarray] | None = None
        if options.initial_pose is not None:
            covariance = options.initial_covariance or np.diag(np.square(_START))
            self.start_at(options.initial_pose, np.asarray(covariance))

    def warm_up(self) -> None:
        """Open the device, and compile the code for scans on the map or a made-up room."""
        cells = np.zeros((80, 80), np.int8)
        cells[[0, -1]] = cells[:, [0, -1]] = 100
        grid = OccupancyGrid(cells, 0.1) if self.grid is None else self.grid
        scanner = Scanner.uniform(angle_min=-math.pi, angle_increment=math.pi / 180, count=360, range_max=10.0)
        made = self.options.make_filter(self.options.make_model(grid, scanner, backend=self.backend), seed=self.seed)
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

    def begin(self) -> None:
        """Count the time without scans from now on."""
        self._taken = self._clock()

    def set_map(self, grid: OccupancyGrid) -> None:
        """Take a map; a filter continues around its last estimate."""
        before, self.grid = self.grid, grid
        if self.filter is None:
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
        self._last = self.estimate = None
        self._history.clear()
        if self.filter is not None:
            self._initialize()

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
        ranges = self._readings(fields, scanner)
        if self._last is not None and not moved_enough(self._last, odometry, self.options.update_min):
            return False
        if self._last is not None:
            self.filter.predict(np.array(self._last), np.array(odometry))
        self.filter.correct(ranges)
        self._last, self.estimate = odometry, self.filter.estimate()
        self._history.append(Moment(ranges, self.estimate.pose, odometry, stamp))
        self.counted, self._cause = self.counted + 1, None
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
        if found.verdict != "tracking" and self._cause is None:
            self._cause = self._likely_cause()
        text = ": ".join(filter(None, (found.verdict, self._cause)))
        return status_fields("filter", LEVELS[found.verdict], text, values, node)

    def _likely_cause(self) -> str:
        """Return the likely cause by the last scan and, with kernels, by the motion between the scans of the run.

        The reference would match those scans for seconds.
        """
        if self.filter.models[0].device.selection != "numpy":
            run = diagnose_run(self.filter.models, self._history, search=False)
            if run.cause in CAUSES_OF_RUNS:
                return run.text
        return str(self.filter.diagnose().text)

    def _readings(self, fields: Mapping[str, Any], scanner: Scanner) -> np.ndarray:
        """Return the readings for the filter's scanner, as in logs; make the filter if it is missing.

        The first scan's geometry is the scanner. After a scan of another geometry, all scans move to common bearings,
        so that varying beams need only a second model. Readings of 0 are missing, and each scan keeps its limits.
        """
        angles, limits = laser_beams(fields), (scanner.range_min, scanner.range_max)
        before, beams = self._scanner, self._beams
        if before is None or beams is None or self.filter is None:
            beams = self._beams = Beams(*angles, *limits)
            self._make(scanner)
        elif not beams.varied and not (
            alike((beams.first, beams.step, beams.count), angles)
            and np.allclose(before.mount, scanner.mount, rtol=0, atol=_SAME_MOUNT)
        ):
            beams = self._beams = Beams(-math.pi, 2 * math.pi / PLACES, PLACES, *limits, varied=True)
            self._make(beams.scanner(scanner.mount, upside_down=False))
        return beams.take(fields)[0]

    def _make(self, scanner: Scanner | None) -> None:
        assert self.grid is not None and scanner is not None
        self._history.clear()
        model = self.options.make_model(self.grid, scanner, backend=self.backend)
        before, self.filter = self.filter, self.options.make_filter(model, seed=self.seed)
        self._scanner = scanner
        if before is not None and self.estimate is not None:
            estimate = before.estimate()
            self.filter.initialize(mean=estimate.pose, covariance=estimate.covariance)
        else:
            self._initialize()

    def _initialize(self) -> None:
        if self._start is None:
            self.filter.initialize_uniform()
        else:
            self.filter.initialize(mean=self._start[0], covariance=self._start[1])


MOST = 500
"""Most waiting scans."""
# Most time that counts as waiting between two looks [s]: a longer one was spent on other work.
_LONGEST = 0.5


class ScanQueue:
    """Queue of scans that wait for their transforms, at most ``patience`` seconds in which the node was idle.

    A scan beyond ``most`` drops the oldest. ``dropped`` counts these, and ``reason`` explains the last.
    """

    def __init__(
        self,
        look_up: Callable[[Any], Any],
        deliver: Callable[[Any, Any], None],
        *,
        patience: float = 1.0,
        most: int = MOST,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._look_up, self._deliver, self._clock = look_up, deliver, clock
        self.patience, self.most = patience, most
        self.dropped = 0
        self.reason: str | None = None
        self._waiting: deque[tuple[float, float, Any]] = deque()
        self._looked, self._waited = clock(), 0.0

    def __len__(self) -> int:
        return len(self._waiting)

    def add(self, scan: Any, stamp: float) -> None:
        """Add a scan, drop waiting ones over 2 s later (a recording restarted), and deliver ready scans."""
        later = [each for each in self._waiting if each[1] > stamp + BACK]
        for each in later:
            self._waiting.remove(each)
            self._drop("the stamps of scans went back")
        self._count()
        self._waiting.append((self._waited, stamp, scan))
        self.check()
        while len(self._waiting) > self.most:
            self._waiting.popleft()
            self._drop(f"more than {self.most} scans wait for their transforms")

    def check(self) -> None:
        """Deliver scans with known transforms, oldest first, and drop scans that waited too long.

        Transforms arrive in the order of time. Scans before a ready one are older than every known transform, and
        never become ready. After a scan that must wait, all others must wait.
        """
        self._count()
        position = 0
        while position < len(self._waiting):
            since, _, scan = self._waiting[position]
            try:
                transforms = self._look_up(scan)
            except TransformError as error:
                if self._waited - since > self.patience:
                    del self._waiting[position]
                    self._drop(f"no transform within {self.patience:g} s: {error}")
                elif error.early:
                    return
                else:
                    position += 1
                continue
            for _ in range(position):
                self._waiting.popleft()
                self._drop("the transforms begin after the scan")
            self._waiting.popleft()
            position = 0
            self._deliver(scan, transforms)
            self._looked = self._clock()

    def clear(self) -> None:
        """Drop all waiting scans, for a deactivated node."""
        self._waiting.clear()

    def _count(self) -> None:
        """Count the time since the last look as waiting."""
        now = self._clock()
        self._waited, self._looked = self._waited + min(now - self._looked, _LONGEST), now

    def _drop(self, reason: str) -> None:
        self.dropped, self.reason = self.dropped + 1, reason
