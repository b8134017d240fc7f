"""Read the scans of several lasers of one log in the order of their times."""

from __future__ import annotations

import heapq
import os
from collections.abc import Iterator, Sequence

from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense.logs.reader import Format, format_of, read_log
from gpusense.logs.records import Odometry, Scan

FRONT, REAR = "front", "rear"


def read_laser(
    path: str | os.PathLike[str],
    topic: str | None = None,
    *,
    range_max: float | None = None,
    mount: ArrayLike | None = None,
) -> Iterator[Scan]:
    """Read the scans of one laser of a log.

    Args:
        path: The log, as for :func:`gpusense.read_log`.
        topic: Topic of the laser in a ROS bag; ``"front"`` or ``"rear"`` for a CARMEN log. None for the laser that
            ``read_log`` takes.
        range_max: Readings of at least this are "no return" [m]; None for the log's.
        mount: Pose of a bag's laser on the robot [m, m, rad]; None takes the mount from the bag's transforms.

    Raises:
        FileNotFoundError: The log is missing.
        ValueError: The log has no such laser, or is broken.
    """
    form = format_of(checks.path("path", path))
    records = _records(form, path, topic, range_max=range_max, mount=mount, odometry=False)
    return (record for record in records if isinstance(record, Scan))


def read_lasers(
    path: str | os.PathLike[str],
    sensors: Sequence[str] = (),
    *,
    range_max: float | None = None,
    mount: ArrayLike | None = None,
) -> Iterator[tuple[int, Scan | Odometry]]:
    """Read scans and odometry.

    Args:
        path: The log, as for :func:`gpusense.read_log`.
        sensors: Topics of the lasers of a ROS bag, whose transforms give their mounts; ``"front"`` or ``"rear"`` for a
            CARMEN log, which states no mounts. None for the laser that ``read_log`` takes.
        range_max: Readings of at least this are "no return" [m]; None for the log's.
        mount: Pose of a bag's only laser on the robot [m, m, rad]; None takes the mounts from the bag's transforms.

    Yields:
        The index of a laser in ``sensors`` with its scan, or 0 with a reading of the odometry.

    Raises:
        FileNotFoundError: The log is missing.
        ValueError: The log has no such laser or is broken, or a mount is passed for several lasers.
    """
    for index, name in enumerate(sensors):
        if name in sensors[:index]:
            raise ValueError(f"sensors: must differ, got {checks.show(name)} twice")
    form = format_of(checks.path("path", path))
    if len(sensors) > 1:
        if not form.topics:
            raise _wrong_laser(form, sensors)
        if mount is not None:
            raise ValueError(f"mount: must be left out for {len(sensors)} lasers, whose transforms have them, got one")
    topics: Sequence[str | None] = sensors or (None,)
    each = [
        _of(index, _records(form, path, topic, range_max=range_max, mount=mount, odometry=index == 0))
        for index, topic in enumerate(topics)
    ]
    return each[0] if len(each) == 1 else heapq.merge(*each, key=lambda one: one[1].time)


def _records(
    form: Format,
    path: str | os.PathLike[str],
    name: str | None,
    *,
    range_max: float | None,
    mount: ArrayLike | None,
    odometry: bool,
) -> Iterator[Scan | Odometry]:
    """Read the records of one laser; None for the laser that ``read_log`` takes.

    Raises:
        ValueError: The log's format has no such laser.
    """
    if form.topics:
        return read_log(path, range_max=range_max, odometry=odometry, topic=name, mount=mount)
    if name not in (None, FRONT, REAR):
        raise _wrong_laser(form, [name])
    return read_log(path, range_max=range_max, odometry=odometry, rear=name == REAR, mount=mount)


def _wrong_laser(form: Format, names: Sequence[object]) -> ValueError:
    rule = f"must be only one of 'front' and 'rear' for {form.name}, which states no mounts"
    return ValueError(f"sensors: {rule}, got {', '.join(map(str, names))}")


def _of(index: int, records: Iterator[Scan | Odometry]) -> Iterator[tuple[int, Scan | Odometry]]:
    """Yield records with the index of their laser."""
    for record in records:
        yield index, record
