"""Read the records of a log of any supported format."""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, overload

from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense._util.lines import numbered_lines
from gpusense.logs.records import Odometry, Scan


@dataclass(frozen=True)
class Format:
    """A format of logs.

    Attributes:
        name: Name of the format in messages, with an article.
        module: The module whose function ``read(file, *, range_max, odometry, rear)`` yields its records.
        suffixes: Suffixes of its files; empty for the format of all files that no other format claims.
        begins: First bytes of its text files, instead of suffixes.
        folder: File in a folder that makes the folder a log of this format; "" if logs are no folders.
        topics: Whether ``read`` also takes ``topic`` and ``mount``.
    """

    name: str
    module: str
    suffixes: tuple[str, ...] = ()
    begins: tuple[bytes, ...] = ()
    folder: str = ""
    topics: bool = False

    def claims(self, file: Path) -> bool:
        """Return whether a file has a suffix or the first bytes of this format."""
        if file.is_dir():
            return bool(self.folder) and (file / self.folder).is_file()
        if self.begins:
            return next((line for _, line in numbered_lines(file)), b"").startswith(self.begins)
        return not self.suffixes or file.name.lower().endswith(self.suffixes)


# The first format that claims a file is used.
FORMATS = (
    Format("a ROS 1 bag", "gpusense.logs.ros", (".bag",), topics=True),
    Format("a ROS 2 bag", "gpusense.logs.ros", (".db3", ".mcap"), folder="metadata.yaml", topics=True),
    Format("a Wean Hall log", "gpusense.logs.wean", begins=(b"L ", b"O ")),
    Format("a CARMEN log", "gpusense.logs.carmen"),
)


@overload
def read_log(
    path: str | os.PathLike[str],
    *,
    range_max: float | None = None,
    odometry: Literal[False] = False,
    rear: bool = False,
    topic: str | None = None,
    mount: ArrayLike | None = None,
) -> Iterator[Scan]: ...


@overload
def read_log(
    path: str | os.PathLike[str],
    *,
    range_max: float | None = None,
    odometry: bool,
    rear: bool = False,
    topic: str | None = None,
    mount: ArrayLike | None = None,
) -> Iterator[Scan | Odometry]: ...


def read_log(
    path: str | os.PathLike[str],
    *,
    range_max: float | None = None,
    odometry: bool = False,
    rear: bool = False,
    topic: str | None = None,
    mount: ArrayLike | None = None,
) -> Iterator[Scan] | Iterator[Scan | Odometry]:
    """Read a log, one record at a time and in the file's order.

    Formats are CARMEN and Wean Hall logs, plain or compressed by gzip, rosbags of ROS 1, and of ROS 2 with sqlite3 or
    MCAP storage, as a folder or a single file. ROS is not needed. The module of each format describes how messages
    become records, such as :mod:`gpusense.logs.carmen` and :mod:`gpusense.logs.ros`.

    Args:
        path: The file, or the folder of a ROS 2 bag.
        range_max: Readings of at least ``range_max`` are "no return" [m]. None takes the limit from the log: the value
            stated in each message, or, for old messages without one, the largest reading of the log. If that reading
            occurs at least three times, it is the scanner's code for "no return"; else the limit is the next float64
            above it, so that every reading is a return. This requires a first pass over the file.
        odometry: Whether to also yield :class:`Odometry` records.
        rear: Whether to yield the scans of the rear laser of a CARMEN log instead of those of the front laser.
        topic: Topic of the scans in a ROS bag; None takes ``/scan``, or the only one.
        mount: Pose (x, y, theta) of a ROS bag's laser on the robot [m, m, rad]; None takes it from the bag's fixed
            transforms. A warning reports that these contradict the given mount, or that there are none and (0, 0, 0) is
            assumed; see also :func:`check_mount`.

    Returns:
        An iterator of :class:`Scan`, and of :class:`Odometry` if ``odometry``.

    Raises:
        FileNotFoundError: The file is missing; raised by the call, as are the next two.
        TypeError: An argument has the wrong type.
        ValueError: ``range_max`` is not finite and > 0, or the file has another format.
        ImportError: While reading a ROS bag, the library rosbags cannot be imported.
        ValueError: While reading, a message breaks the format; the error names the file and the line, or the topic and
            the message's number.

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
        checks.boolean(name, flag)
    form = format_of(file)
    options: dict[str, object] = dict(range_max=range_max, odometry=odometry, rear=rear)
    options |= _ros_options(form, topic, mount)
    records: Iterator[Scan | Odometry] = importlib.import_module(form.module).read(file, **options)
    return records


def format_of(file: Path) -> Format:
    """Return the format of a log.

    Raises:
        FileNotFoundError: It is missing.
        ValueError: It is a folder but no ROS 2 bag.
    """
    if not file.is_dir():
        checks.existing_file(file)
    form = next((each for each in FORMATS if each.claims(file)), None)
    if form is None:
        known = " or ".join(each.name for each in FORMATS)
        raise ValueError(f"{file}: must be {known}, got a folder without metadata.yaml")
    return form


def _ros_options(form: Format, topic: object, mount: ArrayLike | None) -> dict[str, object]:
    """Return the checked options of ROS bags.

    Raises:
        TypeError: ``topic`` is no string, or ``mount`` does not hold numbers.
        ValueError: ``mount`` has another shape, or the format has no topics.
    """
    if topic is not None and not isinstance(topic, str):
        raise TypeError(f"topic: must be a string or None, got {checks.show(topic)}")
    place = None if mount is None else tuple(checks.array("mount", mount, (3,)).tolist())
    if form.topics:
        return dict(topic=topic, mount=place)
    for name, value in (("topic", topic), ("mount", mount)):
        if value is not None:
            raise ValueError(f"{name}: must be left out for {form.name}, got {checks.show(value)}")
    return {}
