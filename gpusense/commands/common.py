"""What the commands share: types of arguments, tables, JSON, files written whole, and the machine's description."""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import platform
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gpusense._util.files import check_writable, write_whole
from gpusense._util.progress import is_terminal
from gpusense._version import __version__

if TYPE_CHECKING:
    from gpusense.backends import Backend, BackendInfo, Device

__all__ = ["check_writable", "write_whole"]

BACKEND_HELP = (
    "where it runs: auto (the fastest device present), numpy, opencl, opencl:<part of a device's or driver's name>, "
    "opencl:<platform>:<device>, warp:cpu or warp:cuda:<number>; 'gpusense devices' lists what is here"
)


def add_backend(parser: argparse.ArgumentParser, *, default: str = "auto") -> None:
    """Add ``--backend``, one selection string; the library checks it when it is used."""
    parser.add_argument("--backend", default=default, metavar="DEVICE", help=f"{BACKEND_HELP} (default: %(default)s)")


def add_json(parser: argparse.ArgumentParser) -> None:
    """Add ``--json``."""
    parser.add_argument(
        "--json", action="store_true", help="print one JSON document on standard output, and nothing else there"
    )


def add_seed(parser: argparse.ArgumentParser) -> None:
    """Add ``--seed``, an integer >= 0 for ``numpy.random.default_rng``."""
    parser.add_argument(
        "--seed", type=whole_number(low=0), default=0, metavar="N",
        help="seed of the random numbers: the same seed gives the same run (default: %(default)s)",
    )  # fmt: skip


def open_backends(selections: Sequence[str] | None) -> tuple[list[Backend], list[str]]:
    """The backends that a user asked for, or else all that are here but simulators.

    Returns:
        Backends, each once, and what went wrong with those that nobody asked for.

    Raises:
        ValueError: a selection names no device that is here.
    """
    from gpusense.backends import devices, get_backend

    if selections is not None:
        return list({backend.info.selection: backend for backend in map(get_backend, selections)}.values()), []
    opened, failures = [], []
    for device in devices():
        if device.available and device.kind != "simulator":
            try:
                opened.append(get_backend(device.selection))
            except Exception as error:
                failures.append(f"{device.selection}: {type(error).__name__}: {error}")
    return opened, failures


def whole_number(*, low: int, high: int | None = None) -> Callable[[str], int]:
    """A type for ``add_argument``: an integer from ``low`` to ``high``, both included."""
    rule = f"must be an integer >= {low}" if high is None else f"must be an integer from {low} to {high}"

    def convert(text: str) -> int:
        try:
            number = int(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{rule}, got {text!r}") from None
        if number < low or (high is not None and number > high):
            raise argparse.ArgumentTypeError(f"{rule}, got {text}")
        return number

    return convert


def positive_number(text: str) -> float:
    """A type for ``add_argument``: a finite number above 0."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not (math.isfinite(number) and number > 0):
        raise argparse.ArgumentTypeError(f"must be a finite number > 0, got {text!r}")
    return number


def output_path(*suffixes: str) -> Callable[[str], Path]:
    """A type for ``add_argument``: a file that can be written, which is tried out before any work is done.

    Args:
        suffixes: The endings that are allowed, such as ``".png"``; none allows every ending.
    """

    def convert(text: str) -> Path:
        path = Path(text)
        if suffixes and path.suffix.lower() not in suffixes:
            raise argparse.ArgumentTypeError(f"must end in {' or '.join(suffixes)}, got {text!r}")
        try:
            check_writable(path)
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) and error.strerror else error
            raise argparse.ArgumentTypeError(f"must be a file that can be written, got {text!r}: {reason}") from None
        return path

    return convert


def print_json(document: dict[str, Any]) -> None:
    """Print one JSON document; numbers that JSON does not have (NaN, infinities) become null."""
    print(json.dumps(_plain(document), indent=2, allow_nan=False))


def _plain(value: Any) -> Any:
    """A value in JSON's own types: mappings, lists, strings, numbers; NumPy's scalars and arrays are taken apart."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, os.PathLike) else value


def print_table(columns: Sequence[str], rows: Sequence[Sequence[str]], *, right: Sequence[str] = ()) -> None:
    """Print a table: drawn by rich on a terminal, plain text elsewhere; ``right`` names the columns of numbers."""
    if not is_terminal(sys.stdout):
        for line in table_lines(columns, rows, right=right):
            print(line)
        return
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for column in columns:
        table.add_column(column, justify="right" if column in right else "left", overflow="fold")
    for row in rows:
        table.add_row(*(Text(text) for text in row))
    Console().print(table)


def table_lines(columns: Sequence[str], rows: Sequence[Sequence[str]], *, right: Sequence[str] = ()) -> list[str]:
    """The lines of a plain table, two spaces between columns."""
    widths = [max(len(text) for text in texts) for texts in zip(columns, *rows, strict=True)]
    lines = []
    for row in (columns, ["-" * width for width in widths], *rows):
        cells = [
            text.rjust(width) if column in right else text.ljust(width)
            for text, width, column in zip(row, widths, columns, strict=True)
        ]
        lines.append("  ".join(cells).rstrip())
    return lines


def grouped(number: int) -> str:
    """A number with spaces between its thousands."""
    return f"{number:,}".replace(",", " ")


def driver_text(device: Device | BackendInfo) -> str:
    """Return what compiles for a device, and how: ``PoCL 3.0, 16 lanes, skylake-avx512``."""
    from gpusense.backends import short_driver

    lanes = f"{device.lanes} lanes" if device.lanes > 1 else ""
    absent = "" if device.float64 or not device.driver else "no float64"
    return ", ".join(part for part in (short_driver(device.driver), lanes, device.target, absent) if part) or "-"


def machine() -> dict[str, Any]:
    """What a report says about where it was made: platform, processor, versions."""
    import numpy as np

    return {
        "gpusense": __version__,
        "platform": platform.platform(),
        "processor": processor_name(),
        "processors": _processors(),
        "python": f"{platform.python_implementation()} {platform.python_version()}",
        "numpy": np.__version__,
    }


def machine_line() -> str:
    """:func:`machine` on one line."""
    facts = machine()
    return (
        f"gpusense {facts['gpusense']}, {facts['processor']} ({facts['processors']} usable), {facts['platform']}, "
        f"{facts['python']}, NumPy {facts['numpy']}"
    )


def processor_name() -> str:
    """The processor's own name, as well as the system tells it."""
    for key in ("model name", "Model", "Hardware"):
        with contextlib.suppress(OSError), open("/proc/cpuinfo", encoding="utf-8", errors="replace") as lines:
            for line in lines:
                name, _, value = line.partition(":")
                if name.strip() == key and value.strip():
                    return value.strip()
    if sys.platform == "darwin":
        import subprocess

        with contextlib.suppress(OSError, subprocess.SubprocessError):
            ask = ["/usr/sbin/sysctl", "-n", "machdep.cpu.brand_string"]
            return subprocess.run(ask, capture_output=True, text=True, check=True, timeout=5).stdout.strip()
    return platform.processor() or platform.machine() or "unknown processor"


def _processors() -> int:
    """How many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
