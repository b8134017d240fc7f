"""Read the records of a log of any supported format, and the scans of one laser or several."""

from __future__ import annotations

import heapq
import importlib
import itertools
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypedDict, Unpack, overload

from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense._util.lines import numbered_lines
from gpusense.logs.bag_storage import MCAP, SQLITE, ZSTD
from gpusense.logs.bags import is_bag_folder
from gpusense.logs.records import Odometry, Scan


@dataclass(frozen=True)
class Format:
    """A format of logs."""

    name: str  # name of the format in messages, with an article
    module: str  # the module whose function ``read(file, *, range_max, range_min, odometry)`` yields its records
    magic: tuple[bytes, ...] = ()  # first bytes of its binary files; they take precedence over suffixes
    suffixes: tuple[str, ...] = ()  # suffixes of its files without these bytes
    begins: tuple[bytes, ...] = ()  # first bytes of its text files
    topics: bool = False  # whether ``read`` also takes the options of bags
    rear: bool = False  # whether ``read`` also takes ``rear``


BAG2 = Format("a ROS 2 bag", "gpusense.logs.ros", (MCAP, SQLITE, ZSTD), (".db3", ".mcap"), topics=True)
# The last format takes all files that no other format claims.
FORMATS = (
    Format("a ROS 1 bag", "gpusense.logs.ros", (b"#ROSBAG V",), (".bag",), topics=True),
    BAG2,
    Format("a Wean Hall log", "gpusense.logs.wean", begins=(b"L ", b"O ")),
    Format("a CARMEN log", "gpusense.logs.carmen", rear=True),
)


class LogOptions(TypedDict, total=False):
    """Options of :func:`read_log` that choose the laser and the odometry."""

    range_max: float | None
    range_min: float | None
    frame: str | None
    mount: ArrayLike | None
    odometry_from: str | None


class _ReadOptions(LogOptions, total=False):
    """Further options of :func:`read_log`."""

    rear: bool
    topic: str | None


@overload
def read_log(
    path: str | os.PathLike[str], *, odometry: Literal[False] = False, **options: Unpack[_ReadOptions]
) -> Iterator[Scan]: ...


@overload
def read_log(
    path: str | os.PathLike[str], *, odometry: bool, **options: Unpack[_ReadOptions]
) -> Iterator[Scan | Odometry]: ...


def read_log(
    path: str | os.PathLike[str],
    *,
    range_max: float | None = None,
    odometry: bool = False,
    rear: bool = False,
    range_min: float | None = None,
    topic: str | None = None,
    frame: str | None = None,
    mount: ArrayLike | None = None,
    odometry_from: str | None = None,
) -> Iterator[Scan] | Iterator[Scan | Odometry]:
    """Read a log, one record at a time and in the file's order.

    Formats are CARMEN and Wean Hall logs, plain or gzipped, rosbags of ROS 1, and rosbags of ROS 2 with sqlite3 or
    MCAP storage, as a folder or a single file. The first bytes of a file decide, then its suffix. ROS is not needed.
    The module of each format describes how messages become records, for example :mod:`gpusense.logs.carmen` and
    :mod:`gpusense.logs.ros`.

    Args:
        path: The file, or the folder of a ROS 2 bag.
        range_max: Readings of at least ``range_max`` are "no return" [m]. None takes the value of each message; for
            old messages without one it takes the largest reading of the log, in a first pass over the file. If this
            reading occurs at least three times, it is the scanner's code for "no return"; otherwise the limit is the
            next float64 above it, so that every reading is a return. In a ROS bag ``range_max`` replaces the messages'
            value.
        odometry: Whether to also yield :class:`Odometry` records.
        rear: Whether to yield the rear laser's scans of a CARMEN log instead of the front laser's.
        range_min: Readings below ``range_min`` are missing [m]; None takes the messages' value in a ROS bag, else 0.
        topic: Topic of the scans in a ROS bag; None takes ``/scan``, or the only one.
        frame: Frame of the laser, if several lasers of a ROS bag share the topic; None reads all lasers, each with the
            mount of its frame.
        mount: Pose (x, y, theta) of a ROS bag's laser on the robot [m, m, rad]; None takes it from the bag's
            transforms. A warning reports transforms that contradict ``mount``, or missing transforms, for which (0, 0,
            0) is assumed; see also :func:`check_mount`.
        odometry_from: Topic of the odometry in a ROS bag, or the frame of the transforms that move the robot's base;
            None takes a topic in the scans' namespace, ``/odom``, the first topic by name, or a frame such as ``odom``.
            A warning lists the alternatives.

    Returns:
        An iterator of :class:`Scan`, and of :class:`Odometry` if ``odometry``.

    Raises:
        FileNotFoundError: The file is missing; raised by the call, as are the next two.
        TypeError: An argument has the wrong type.
        ValueError: A limit of ranges breaks its rule, an option does not suit the format, or a folder is no bag.
        ImportError: While reading a ROS bag, the library rosbags cannot be imported.
        ValueError: While reading, the file or most messages break the format; the error names the file and the place. A
            warning counts the messages that are skipped.

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
    if range_min is not None:
        range_min = checks.real("range_min", range_min, low=0)
    for name, flag in (("odometry", odometry), ("rear", rear)):
        checks.boolean(name, flag)
    form = format_of(file)
    options: dict[str, object] = dict(range_max=range_max, range_min=range_min, odometry=odometry)
    if form.rear:
        options["rear"] = rear
    elif rear:
        lasers = "whose lasers have topics (topic=)" if form.topics else "whose robot has one laser"
        raise ValueError(f"rear: must be False for {form.name}, {lasers}, got True")
    options |= _ros_options(form, mount, topic=topic, frame=frame, odometry_from=odometry_from)
    records: Iterator[Scan | Odometry] = importlib.import_module(form.module).read(file, **options)
    return records


def format_of(file: Path) -> Format:
    """Return the format of a log."""
    if file.is_dir():
        if is_bag_folder(file):
            return BAG2
        known = " or ".join(each.name for each in FORMATS)
        raise ValueError(f"{file}: must be {known}, got a folder without metadata.yaml, .db3 or .mcap files")
    checks.existing_file(file)
    with file.open("rb") as stream:
        head = stream.read(16)
    found = [each for each in FORMATS if head.startswith(each.magic)]
    found = found or [each for each in FORMATS if file.name.lower().endswith(each.suffixes)]
    if not found:
        first = next((line for _, line in numbered_lines(file)), b"")
        found = [each for each in FORMATS if first.startswith(each.begins)]
    return (found or FORMATS[-1:])[0]


def _ros_options(form: Format, mount: ArrayLike | None, **others: object) -> dict[str, object]:
    for name in ("topic", "frame", "odometry_from"):
        if others[name] is not None and not isinstance(others[name], str):
            raise TypeError(f"{name}: must be a string or None, got {checks.show(others[name])}")
    place = None if mount is None else tuple(checks.array("mount", mount, (3,)).tolist())
    if form.topics:
        return {**others, "mount": place}
    for name, value in {**others, "mount": mount}.items():
        if value is not None:
            raise ValueError(f"{name}: must be left out for {form.name}, got {checks.show(value)}")
    return {}


FRONT, REAR = "front", "rear"


def read_lasers(
    path: str | os.PathLike[str],
    sensors: Sequence[str] = (),
    *,
    odometry: bool = True,
    **options: Unpack[LogOptions],
) -> Iterator[tuple[int, Scan | Odometry]]:
    """Yield the index of a laser in ``sensors`` with its scan, or 0 with an odometry reading if ``odometry``.

    ``sensors`` names topics of a ROS bag's lasers, with mounts from transforms, or ``"front"`` or ``"rear"`` for a
    CARMEN log, which states no mounts. None is the laser that ``read_log`` takes.
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
    each = [
        zip(itertools.repeat(index), _records(form, path, topic, odometry and index == 0, options))
        for index, topic in enumerate(topics)
    ]
    return each[0] if len(each) == 1 else heapq.merge(*each, key=lambda one: one[1].time)


def _records(
    form: Format, path: str | os.PathLike[str], name: str | None, odometry: bool, options: LogOptions
) -> Iterator[Scan | Odometry]:
    """Read the records of one laser; None for the laser that ``read_log`` takes."""
    if form.topics:
        return read_log(path, odometry=odometry, topic=name, **options)
    if name not in (None, FRONT) and not (form.rear and name == REAR):
        raise _wrong_laser(form, [name])
    return read_log(path, odometry=odometry, rear=name == REAR, **options)


def _wrong_laser(form: Format, names: Sequence[object]) -> ValueError:
    rule = f"must be left out for {form.name}, whose robot has one laser"
    if form.rear:
        rule = f"must be only one of 'front' and 'rear' for {form.name}, which states no mounts"
    return ValueError(f"sensors: {rule}, got {', '.join(map(str, names))}")
