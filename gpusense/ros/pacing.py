"""Pace a node without ROS: queue scans for their transforms, rest after costly work, and count lost messages."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from gpusense.logs.transform_buffer import BACK, TransformError

MOST = 500
"""Most waiting scans."""
# Most time that counts as waiting between two looks [s]: a longer one was spent on other work.
_LONGEST = 0.5
# Time of deliveries after which other callbacks have their turn [s].
_TURN = 0.25
# Rest after costly work, in durations of the work.
_RESTS = 10
# Step of publication numbers that suggests another publisher, and most publishers that are distinguished.
_GAP, _PUBLISHERS = 10_000, 8


class Rest:
    """Rest after costly work, so that it takes about a tenth of the time at most."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._end = clock, -math.inf

    @property
    def over(self) -> bool:
        """Whether the work may start again."""
        return self._clock() >= self._end

    @contextmanager
    def after(self) -> Iterator[None]:
        """Measure the work of a block, and rest after it."""
        begin = self._clock()
        try:
            yield
        finally:
            end = self._clock()
            self._end = end + _RESTS * (end - begin)


class Losses:
    """Count the messages of a topic that were lost, by the numbers of their publications.

    Publishers number their messages separately, and some releases of ROS do not name the publisher. A number follows
    the nearest one at or below it. A middleware without numbers shows no losses.
    """

    def __init__(self) -> None:
        self._last: list[int] = []

    def take(self, number: int | None) -> int:
        """Take the number of a message; return how many were lost before it."""
        if number is None:
            return 0
        before = max((each for each in self._last if number - _GAP < each <= number), default=None)
        if before is not None:
            self._last.remove(before)
        self._last = [*self._last[1 - _PUBLISHERS :], number]
        return 0 if before is None else max(number - before - 1, 0)


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
        never become ready. After a scan that must wait, all others must wait. Deliveries end after a fourth of a
        second, and the next check continues.
        """
        self._count()
        position, end = 0, self._clock() + _TURN
        while position < len(self._waiting):
            since, _, scan = self._waiting[position]
            try:
                transforms = self._look_up(scan)
            except TransformError as error:
                if self._waited - since > self.patience:
                    del self._waiting[position]
                    self._drop(f"no transform within {self.patience:g} s: {error}")
                elif error.early or (position == 0 and self._is_unknown(self._waiting[-1][2])):
                    return
                else:
                    position += 1
                continue
            for _ in range(position):
                self._waiting.popleft()
                self._drop("the transforms begin after the scan")
            self._waiting.popleft()
            position = 0
            try:
                self._deliver(scan, transforms)
            finally:
                self._looked = self._clock()
            if self._looked > end:
                return

    def _is_unknown(self, scan: Any) -> bool:
        """Return whether a scan's transforms are unknown, though not too early; so are those of older scans then."""
        try:
            self._look_up(scan)
        except TransformError as error:
            return not error.early
        return False

    def clear(self) -> None:
        """Drop all waiting scans, for a deactivated node."""
        self._waiting.clear()

    def _count(self) -> None:
        """Count the time since the last look as waiting."""
        now = self._clock()
        self._waited, self._looked = self._waited + min(now - self._looked, _LONGEST), now

    def _drop(self, reason: str) -> None:
        self.dropped, self.reason = self.dropped + 1, reason
