"""Bad logs, with the exact message of each."""

from __future__ import annotations

import gzip
from typing import Any

from support.bad_input_files import Action, put

from gpusense.logs import read_log
from gpusense.logs.reader import FORMATS

GOOD_LINE = "FLASER 3 1.0 2.0 3.0 1 2 3 4 5 6 12.5 robot 0.5"

WEAN_LINE = "L 0 0 0 25 0 0 " + "100 " * 180 + "0.5"


def log_with(*lines: str, name: str = "run.log", **options: Any) -> Action:
    """Read a whole log of these lines."""
    return lambda tmp: list(read_log(put(tmp, name, "".join(f"{line}\n" for line in lines)), **options))


LOG = "{tmp}/input/run.log"
KNOWN = " or ".join(form.name for form in FORMATS)


def bad_lines(message: str, *lines: str, **options: Any) -> tuple[Action, type[Exception], str]:
    """Return the case of a log of these lines that is refused with a message after the log's name."""
    return log_with(*lines, **options), ValueError, LOG + message


V, T = ValueError, TypeError
LOG_CASES = [
    (lambda tmp: read_log(tmp / "absent.log"), FileNotFoundError, "{tmp}/absent.log: must exist, got no such file"),
    (lambda tmp: read_log(put(tmp, "readme.txt", "").parent), V,
     f"{{tmp}}/input: must be {KNOWN}, got a folder without metadata.yaml, .db3 or .mcap files"),
    (log_with(GOOD_LINE, topic="/scan"), V, "topic: must be left out for a CARMEN log, got '/scan'"),
    (log_with(GOOD_LINE, topic=1), T, "topic: must be a string or None, got 1"),
    (log_with(GOOD_LINE, mount=(0, 0, 0)), V, "mount: must be left out for a CARMEN log, got (0, 0, 0)"),
    (log_with("data", name="run.bag", rear=True), V,
     "rear: must be False for a ROS bag, whose lasers have topics (topic=), got True"),
    bad_lines(":2: must begin with L or O, got 'X'", WEAN_LINE, "X 1 2"),
    bad_lines(":2: O: must have 5 fields, got 3", WEAN_LINE, "O 1 2"),
    bad_lines(":1: O: field 2 must be a finite number, got '1_0'", "O 0 1_0 0 1"),
    bad_lines(":1: O: field 4 must be a finite number, got 'nan'", "O 0 0 0 nan"),
    bad_lines(":2: L: the laser must stay at (0.25, 0.0, 0.0) on the robot, got (0.5, 0.0, 0.0)", WEAN_LINE,
     WEAN_LINE.replace("25 0 0", "50 0 0")),
    (log_with("O 0 0 0 1", rear=True), V,
     "rear: must be False for a Wean Hall log, whose robot has one laser, got True"),
    (log_with(GOOD_LINE, range_max=-1), V, "range_max: must be finite and > 0, got -1"),
    (log_with(GOOD_LINE, odometry=1), T, "odometry: must be True or False, got 1"),
    bad_lines(": must hold laser or ODOM messages of CARMEN, got none in 2 lines", "hello", "world"),
    bad_lines(":3: FLASER: must have 14 fields, got 10", "# a log", GOOD_LINE, GOOD_LINE[:30]),
    bad_lines(":1: FLASER: field 1 must be a count, got ''", "FLASER"),
    bad_lines(":1: FLASER: field 1 must be a count, got '-3'", GOOD_LINE.replace("FLASER 3", "FLASER -3")),
    bad_lines(f":1: FLASER: field 1 must be a count, got '{'7' * 40}'",
     GOOD_LINE.replace("FLASER 3", f"FLASER {'7' * 1000}")),
    bad_lines(":1: FLASER: field 1 must count at most 12 values, got 1000000000",
     GOOD_LINE.replace("FLASER 3", "FLASER 1000000000")),
    bad_lines(":1: FLASER: must have 13 fields, got 14", GOOD_LINE.replace("FLASER 3", "FLASER 2")),
    bad_lines(":2: FLASER: field 3 must be a number, got '2.O'", GOOD_LINE, GOOD_LINE.replace("2.0", "2.O")),
    bad_lines(":1: FLASER: field 3 must be a number, got '2_0'", GOOD_LINE.replace("2.0", "2_0")),
    bad_lines(":1: FLASER: field 11 must be a number, got 'noon'", GOOD_LINE.replace("12.5", "noon")),
    bad_lines(":1: a pose must be finite, got (1.0, 2.0, nan)", GOOD_LINE.replace("1 2 3 4", "1 2 nan 4")),
    bad_lines(":1: ODOM: must have 10 fields, got 9", "ODOM 1 2 3 0 0 0 1.0 robot"),
    bad_lines(": must have a reading > 0 unless range_max is given, got none",
     "FLASER 1 0.0 1 2 3 4 5 6 1.0 robot 1.0"),
    bad_lines(":1: ROBOTLASER1: field 10 must count at most 14 values, got 999999999",
     "ROBOTLASER1 0 -1.57 3.14 0.1 80 0.01 0 1 2.5 999999999 1 2 3 4 5 6 0 0 0 0 0 1.0 robot 1.0"),
    bad_lines(":1: range_max: must be finite and > 0, got 0.0",
     "ROBOTLASER1 0 -1.57 3.14 0.1 0 0.01 0 1 2.5 0 1 2 3 4 5 6 0 0 0 0 0 1.0 robot 1.0"),
    (lambda tmp: list(read_log(put(tmp, "run.log", gzip.compress(GOOD_LINE.encode())[:-9]), range_max=5)), V,
     f"{LOG}:1: must be a whole gzip file, got one that is cut off: Compressed file ended before the end-of-stream "
     "marker was reached"),
]  # fmt: skip
