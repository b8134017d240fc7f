"""Read the scans of several lasers of a log by time."""

from __future__ import annotations

import heapq
import os
from collections.abc import Iterator, Sequence
from typing import Unpack

from gpusense._util import checks
from gpusense.logs.reader import Format, LogOptions, format_of, read_log
from gpusense.logs.records import Odometry, Scan

FRONT, REAR = "front", "rear"


def read_laser(
    path: str | os.PathLike[str],
    topic: str | None = None,
    **options: Unpack[LogOptions],
) -> Iterator[Scan]:
    """Read the scans of one laser of a log.

    Args:
        path: The log, as for :func:`gpusense.read_log`.
        topic: Topic of the laser in a ROS bag; ``"front"`` or ``"rear"`` for a CARMEN log. None for the laser that
            ``read_log`` takes.
        options: See :func:`gpusense.read_log`.
    """
    form = format_of(checks.path("path", path))
    records = _records(form, path, topic, False, options)
    return (record for record in records if isinstance(record, Scan))


def read_lasers(
    path: str | os.PathLike[str],
    sensors: Sequence[str] = (),
    **options: Unpack[LogOptions],
) -> Iterator[tuple[int, Scan | Odometry]]:
    """Read scans and odometry.

    Args:
        path: The log, as for :func:`gpusense.read_log`.
        sensors: Topics of a ROS bag's lasers, with mounts from transforms; ``"front"`` or ``"rear"`` for a CARMEN log,
            which states no mounts. None for the laser that ``read_log`` takes.
        options: See :func:`gpusense.read_log`.

    Yields:
        The index of a laser in ``sensors`` with its scan, or 0 with an odometry reading.
    """
    for index, name in enumerate(sensors):
        if name in sensors[:index]:
            raise ValueError(f"sensors: must differ, got {checks.show(name)} twice")
    form = format_of(checks.path("path", path))
    if len(sensors) > 1:
        if not form.topics:
            raise _wrong_laser(form, sensors)
        if options.get("mount") is not None:
            raise ValueError(f"mount: must be left out for {len(sensors)} lasers, whose transforms have them, got one")
    topics: Sequence[str | None] = sensors or (None,)
    each = [_of(index, _records(form, path, topic, index == 0, options)) for index, topic in enumerate(topics)]
    return each[0] if len(each) == 1 else heapq.merge(*each, key=lambda one: one[1].time)


def _records(
    form: Format, path: str | os.PathLike[str], name: str | None, odometry: bool, options: LogOptions
) -> Iterator[Scan | Odometry]:
    """Read the records of one laser; None for the laser that ``read_log`` takes."""
    if form.topics:
        return read_log(path, odometry=odometry, topic=name, **options)
    if name not in (None, FRONT, REAR):
        raise _wrong_laser(form, [name])
    return read_log(path, odometry=odometry, rear=name == REAR, **options)


def _wrong_laser(form: Format, names: Sequence[object]) -> ValueError:
    rule = f"must be only one of 'front' and 'rear' for {form.name}, which states no mounts"
    return ValueError(f"sensors: {rule}, got {', '.join(map(str, names))}")


def _of(index: int, records: Iterator[Scan | Odometry]) -> Iterator[tuple[int, Scan | Odometry]]:
    """Yield records with the index of their laser."""
    for record in records:
        yield index, record
