"""Filter messages without ROS: scans wait until the transforms at their stamps are known.

tf2_ros has a message filter only for C++. A scan often arrives before the odometry of its time, so an immediate
look-up would lose it.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Any

from gpusense.logs.transform_buffer import BACK, TransformError

MOST = 500
"""Most waiting scans."""


class ScanQueue:
    """Queue of scans that wait for their transforms, at most ``patience`` seconds without the delivery of others.

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
        self._busy = 0.0

    def __len__(self) -> int:
        return len(self._waiting)

    def add(self, scan: Any, stamp: float) -> None:
        """Add a scan, and deliver ready scans.

        Waiting scans that are later by more than 2 s are dropped: a recording has restarted, or their stamps were
        wrong.
        """
        later = [each for each in self._waiting if each[1] > stamp + BACK]
        for each in later:
            self._waiting.remove(each)
            self._drop("the stamps of scans went back")
        self._waiting.append((self._idle(), stamp, scan))
        self.check()
        while len(self._waiting) > self.most:
            self._waiting.popleft()
            self._drop(f"more than {self.most} scans wait for their transforms")

    def check(self) -> None:
        """Deliver scans with known transforms, oldest first, and drop scans that waited too long.

        Transforms arrive in the order of time. Scans before a ready one are older than every known transform, and
        never become ready. After a scan that must wait, all others must wait.
        """
        position = 0
        while position < len(self._waiting):
            since, _, scan = self._waiting[position]
            try:
                transforms = self._look_up(scan)
            except TransformError as error:
                if self._idle() - since > self.patience:
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
            begin = self._clock()
            self._deliver(scan, transforms)
            self._busy += self._clock() - begin

    def clear(self) -> None:
        """Drop all waiting scans, for a deactivated node."""
        self._waiting.clear()

    def _idle(self) -> float:
        return self._clock() - self._busy

    def _drop(self, reason: str) -> None:
        self.dropped, self.reason = self.dropped + 1, reason
