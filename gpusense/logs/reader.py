"""``read_log``: one iterator of records, whatever the file."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Literal, overload

from gpusense._util import checks
from gpusense.logs.records import Odometry, Scan

_OTHER_FORMATS = {".bag": "a ROS 1 bag", ".db3": "a ROS 2 bag", ".mcap": "an MCAP file"}


@overload
def read_log(
    path: str | os.PathLike[str],
    *,
    range_max: float | None = None,
    odometry: Literal[False] = False,
    rear: bool = False,
) -> Iterator[Scan]: ...


@overload
def read_log(
    path: str | os.PathLike[str],
    *,
    range_max: float | None = None,
    odometry: bool,
    rear: bool = False,
) -> Iterator[Scan | Odometry]: ...


def read_log(
    path: str | os.PathLike[str],
    *,
    range_max: float | None = None,
    odometry: bool = False,
    rear: bool = False,
) -> Iterator[Scan] | Iterator[Scan | Odometry]:
    """Read a log, one record at a time and in the file's order.

    This version reads CARMEN logs, plain or compressed by gzip. See :mod:`gpusense.logs.carmen` for what
    becomes of their messages.

    Args:
        path: the file.
        range_max: readings of at least this are "no return" [m]. None takes it from the log: what a message
            states itself; for the old messages, which state nothing, the log's largest reading if that
            occurs at least three times (it is then what the scanner gives for "no return"), else the next
            float64 above it, so that every reading is a return. That takes a first pass over the file.
        odometry: also yield :class:`Odometry` records.
        rear: yield the scans of the rear laser instead of the front laser's.

    Returns:
        An iterator of :class:`Scan`, and :class:`Odometry` where asked for.

    Raises:
        FileNotFoundError: the file is missing; raised by the call, as are the next two.
        TypeError: an argument is not of the kind described.
        ValueError: ``range_max`` is not finite and > 0, or the file has another format.
        ValueError: while reading, a message breaks the format; it names the file and the line.
    """
    file = checks.path("path", path)
    if range_max is not None:
        range_max = checks.real("range_max", range_max, above=0)
    for name, flag in (("odometry", odometry), ("rear", rear)):
        if not isinstance(flag, bool):
            raise TypeError(f"{name}: must be True or False, got {checks.show(flag)}")
    found = _OTHER_FORMATS.get(file.suffix.lower())
    if file.is_dir():
        found = "a ROS 2 bag" if (file / "metadata.yaml").exists() else "a folder"
    if found is not None:
        raise ValueError(f"{file}: must be a CARMEN log, which is all that this version reads, got {found}")
    checks.existing_file(file)

    from gpusense.logs.carmen import read_carmen

    return read_carmen(file, range_max=range_max, odometry=odometry, rear=rear)
