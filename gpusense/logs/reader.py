"""Read the records of a log of any supported format."""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, overload

from gpusense._util import checks
from gpusense.logs.records import Odometry, Scan


@dataclass(frozen=True)
class Format:
    """A format of logs.

    Attributes:
        name: Its name in messages, with an article.
        module: The module whose function ``read(file, *, range_max, odometry, rear)`` yields its records.
        suffixes: The ends of its files' names; empty for the format of all files that no other claims.
    """

    name: str
    module: str
    suffixes: tuple[str, ...] = ()

    def claims(self, file: Path) -> bool:
        """Return whether a file has a name of this format."""
        return not self.suffixes or file.name.lower().endswith(self.suffixes)


# The first format that claims a file reads it.
FORMATS = (Format("a CARMEN log", "gpusense.logs.carmen"),)
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

    This version reads CARMEN logs, plain or compressed by gzip. The module of each format describes how messages become
    records, such as :mod:`gpusense.logs.carmen`.

    Args:
        path: The file.
        range_max: Readings of at least ``range_max`` are "no return" [m]. None takes the limit from the log: the value
            stated in each message, or, for old messages without one, the largest reading of the log. If that reading
            occurs at least three times, it is the scanner's code for "no return"; else the limit is the next float64
            above it, so that every reading is a return. This takes a first pass over the file.
        odometry: Whether to yield :class:`Odometry` records, too.
        rear: Whether to yield the scans of the rear laser instead of those of the front laser.

    Returns:
        An iterator of :class:`Scan`, and of :class:`Odometry` if ``odometry``.

    Raises:
        FileNotFoundError: The file is missing; raised by the call, as are the next two.
        TypeError: An argument has the wrong type.
        ValueError: ``range_max`` is not finite and > 0, or the file has another format.
        ValueError: While reading, a message breaks the format; the error names the file and the line.

    Example:
        >>> import gpusense as gs, pathlib, tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     log = pathlib.Path(folder, "run.clf")
        ...     _ = log.write_text("FLASER 3 1.0 2.5 8.0 0 0 0 0 0 0 12.5 host 12.5")
        ...     [scan.ranges.tolist() for scan in gs.read_log(log, range_max=8.0)]
        [[1.0, 2.5, 8.0]]
    """
    file = checks.path("path", path)
    if range_max is not None:
        range_max = checks.real("range_max", range_max, above=0)
    for name, flag in (("odometry", odometry), ("rear", rear)):
        if not isinstance(flag, bool):
            raise TypeError(f"{name}: must be True or False, got {checks.show(flag)}")
    other = _OTHER_FORMATS.get(file.suffix.lower())
    if file.is_dir():
        other = "a ROS 2 bag" if (file / "metadata.yaml").exists() else "a folder"
    if other is not None:
        known = " or ".join(each.name for each in FORMATS)
        raise ValueError(f"{file}: must be {known}, which is all that this version reads, got {other}")
    checks.existing_file(file)
    form = next(each for each in FORMATS if each.claims(file))
    records: Iterator[Scan | Odometry] = importlib.import_module(form.module).read(
        file, range_max=range_max, odometry=odometry, rear=rear
    )
    return records
