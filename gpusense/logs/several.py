"""Read the scans of several lasers of one log in the order of their times."""

from __future__ import annotations

import heapq
import os
from collections.abc import Iterator, Sequence

from gpusense._util import checks
from gpusense.logs.reader import format_of, read_log
from gpusense.logs.records import Odometry, Scan

FRONT, REAR = "front", "rear"


def read_lasers(
    path: str | os.PathLike[str], sensors: Sequence[str] = (), *, range_max: float | None = None
) -> Iterator[tuple[int, Scan | Odometry]]:
    """Read scans and odometry.

    Args:
        path: The log, as for :func:`gpusense.read_log`.
        sensors: Topics of the lasers of a ROS bag, whose transforms have their mounts; ``"front"`` or ``"rear"`` for a
            CARMEN log, which states no mounts. None of them is the laser that ``read_log`` takes.
        range_max: Readings of at least this are "no return" [m]; None for the log's.

    Yields:
        The index of a laser in ``sensors``, and its scan; 0 and a reading of the odometry.

    Raises:
        FileNotFoundError: The log is missing.
        ValueError: A laser that the log does not have, or a broken log.
    """
    for index, name in enumerate(sensors):
        if name in sensors[:index]:
            raise ValueError(f"sensors: must differ, got {checks.show(name)} twice")
    form = format_of(checks.path("path", path))
    if sensors and not form.topics:
        if len(sensors) > 1 or sensors[0] not in (FRONT, REAR):
            rule = f"must be only one of 'front' and 'rear' for {form.name}, which states no mounts"
            raise ValueError(f"sensors: {rule}, got {', '.join(sensors)}")
        return _of(0, read_log(path, range_max=range_max, odometry=True, rear=sensors[0] == REAR))
    topics: Sequence[str | None] = sensors or (None,)
    each = [
        _of(index, read_log(path, range_max=range_max, odometry=index == 0, topic=topic))
        for index, topic in enumerate(topics)
    ]
    return each[0] if len(each) == 1 else heapq.merge(*each, key=lambda one: one[1].time)


def _of(index: int, records: Iterator[Scan | Odometry]) -> Iterator[tuple[int, Scan | Odometry]]:
    """Yield records with the index of their laser."""
    for record in records:
        yield index, record
