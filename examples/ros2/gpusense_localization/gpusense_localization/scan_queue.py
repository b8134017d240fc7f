"""The message filter of the node, without ROS: scans wait until the transforms at their stamps are known.

tf2_ros has a message filter for C++ alone. A scan often arrives before the odometry of its time does, so a look-up at
once would lose it.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Any

# As in nav2_amcl.
MOST = 50


class NotYetError(Exception):
    """The transforms of a scan are not known yet; its text is the reason."""


class ScanQueue:
    """Scans in their order, each of which waits for its transforms.

    Args:
        look_up: Returns the transforms of a scan, or raises :class:`NotYetError`.
        deliver: Takes a scan and its transforms.
        patience: Longest wait of a scan [s].
        most: Most scans that wait; one more drops the oldest.
        clock: Returns the time [s].

    Attributes:
        dropped: Number of scans that were not delivered.
        reason: Why the last of them was not; None where there is none.
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
        self.dropped, self.reason = 0, None
        self._waiting: deque[tuple[float, Any]] = deque()

    def __len__(self) -> int:
        return len(self._waiting)

    def add(self, scan: Any) -> None:
        """Take a scan, and deliver what is ready."""
        self._waiting.append((self._clock(), scan))
        self.check()
        while len(self._waiting) > self.most:
            self._waiting.popleft()
            self._drop(f"more than {self.most} scans wait for their transforms")

    def check(self) -> None:
        """Deliver scans whose transforms are known, oldest first, and drop those that waited too long.

        Transforms arrive in the order of time. Where a scan is ready, those before it are older than all that is known,
        and never will be.
        """
        position = 0
        while position < len(self._waiting):
            since, scan = self._waiting[position]
            try:
                transforms = self._look_up(scan)
            except NotYetError as error:
                if self._clock() - since > self.patience:
                    del self._waiting[position]
                    self._drop(f"no transform within {self.patience:g} s: {error}")
                else:
                    position += 1
                continue
            for _ in range(position):
                self._waiting.popleft()
                self._drop("the transforms begin after the scan")
            self._waiting.popleft()
            position = 0
            self._deliver(scan, transforms)

    def clear(self) -> None:
        """Forget the scans that wait, as when the node is deactivated."""
        self._waiting.clear()

    def _drop(self, reason: str) -> None:
        self.dropped, self.reason = self.dropped + 1, reason
