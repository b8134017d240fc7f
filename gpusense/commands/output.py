"""Print JSON and tables, and format numbers and drivers."""

from __future__ import annotations

import json
import math
import os
import platform
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gpusense._util.documents import plain
from gpusense._util.files import write_whole
from gpusense._util.progress import is_terminal
from gpusense._version import __version__

if TYPE_CHECKING:
    import argparse

    from matplotlib.figure import Figure

    from gpusense.backends import BackendInfo, Device

# Columns of a line of facts, and of their names.
_WIDTH, _INDENT = 80, 11
# Programs that open files with a suffix, if no picture viewer or editor does.
_OPENERS = {".rrd": "rerun", ".tum": "evo_traj tum"}


def document(document: dict[str, Any]) -> None:
    """Print one JSON document; NaN and infinities become null."""
    print(json.dumps(plain(document), indent=2, allow_nan=False))


def report(facts: dict[str, Any], args: argparse.Namespace | None = None) -> None:
    """Print facts as a JSON document, between the options of a command and the machine."""
    hidden = ("run", "command", "json")
    options = {} if args is None else {"options": {k: v for k, v in vars(args).items() if k not in hidden}}
    document({**options, **facts, "machine": machine()})


def machine() -> dict[str, Any]:
    """Return platform, processor, number of usable processors and versions, by name."""
    from gpusense.backends import processor

    return {
        "gpusense": __version__, "platform": platform.platform(), "processor": processor.name(),
        "processors": processor.threads(),
        "python": f"{platform.python_implementation()} {platform.python_version()}", "numpy": np.__version__,
    }  # fmt: skip


def machine_line() -> str:
    """Format :func:`machine` as one line."""
    facts = machine()
    return (
        f"gpusense {facts['gpusense']}, {facts['processor']} ({facts['processors']} usable), {facts['platform']}, "
        f"{facts['python']}, NumPy {facts['numpy']}"
    )


def result(text: str) -> None:
    """Print the result of a command: in one line, on a terminal wrapped and in bold."""
    if is_terminal(sys.stdout):
        text = _wrapped(text, min(shutil.get_terminal_size().columns, _WIDTH))
        text = text if "NO_COLOR" in os.environ else f"\033[1m{text}\033[0m"
    print(text, flush=True)


def fact(name: str, text: str) -> None:
    """Print a named fact below the result, wrapped to 80 columns."""
    print(_wrapped(f"{name:<{_INDENT - 1}} {text}", _WIDTH, " " * _INDENT))


def interrupted(done: int, total: int, noun: str = "scans") -> None:
    """Print the share of the work that an interrupted command did."""
    if done < total:
        print(f"interrupted: results of {done} of {total} {noun}")


def details(args: argparse.Namespace, *texts: str) -> None:
    """Print details and the machine, with ``--verbose``."""
    if args.verbose:
        print("", *texts, machine_line(), sep="\n")


def files(*paths: os.PathLike[str] | None) -> None:
    """Print the files that a command wrote, with the command that opens each; None is left out."""
    for path in filter(None, paths):
        opener = _OPENERS.get(os.path.splitext(path)[1].lower())
        print(f"{'written':<{_INDENT}}{path}{f'; open it with: {opener} {path}' if opener else ''}")


def draw(path: Path | None, make: Callable[[], Figure]) -> None:
    """Draw a picture, if a file for it is passed."""
    if path is not None:
        from gpusense.plots.drawing import save

        save(make(), path)


def write_table(path: Path | None, **columns: Iterable[Any]) -> None:
    """Write a CSV file of named columns, if a path is passed; numbers have nine digits, and NaN is an empty field."""
    if path is None:
        return

    def text(value: Any) -> str:
        if isinstance(value, (float, np.floating)):
            return "" if math.isnan(value) else f"{value:.9g}"
        return str(value)

    lines = [",".join(columns), *(",".join(map(text, row)) for row in zip(*columns.values(), strict=True))]
    write_whole(path, lambda stream: stream.write(("\n".join(lines) + "\n").encode()))


def _wrapped(text: str, width: int, indent: str = "") -> str:
    return textwrap.fill(text, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)


def table(columns: Sequence[str], rows: Sequence[Sequence[str]], *, right: Sequence[str] = ()) -> None:
    """Print a table; on a terminal that is too narrow, each row becomes a paragraph with one value per line."""
    widths = [max(map(len, texts)) for texts in zip(columns, *rows, strict=True)]
    lines = []
    for row in (columns, ["-" * width for width in widths], *rows):
        cells = zip(row, widths, [">" if name in right else "<" for name in columns], strict=True)
        lines.append("  ".join(f"{text:{side}{width}}" for text, width, side in cells).rstrip())
    if is_terminal(sys.stdout) and max(map(len, lines)) > shutil.get_terminal_size().columns:
        widest, lines = max(map(len, columns)), []
        for row in rows:
            lines += [f"{name:<{widest}}  {text}" for name, text in zip(columns, row, strict=True) if text]
            lines.append("")
    print(*lines, sep="\n")


def counted(number: int, noun: str, plural: str | None = None) -> str:
    """Return a number with a noun: ``"1 scan"``, ``"3 scans"``."""
    return f"{number} {noun if number == 1 else plural or noun + 's'}"


def length(metres: float) -> str:
    """Format a length with two digits in a suitable unit."""
    if metres < 0.01:
        return f"{metres * 1000:.2g} mm"
    return f"{metres * 100:.2g} cm" if metres < 0.995 else f"{metres:.1f} m"


def degrees(radians: float) -> str:
    """Format an angle in degrees with two digits, down to a hundredth of a degree."""
    return f"{round(math.degrees(radians), 2):.2g}"


def rounded(value: float, error: float) -> tuple[str, str]:
    """Format a value and its standard error, both to the error's two digits; "-" for an unknown number."""
    if not math.isfinite(value):
        return "-", "-"
    if not (math.isfinite(error) and error > 0):
        return f"{value:.4g}", "inf" if error == math.inf else "-"
    digits = min(max(1 - math.floor(math.log10(error)), 0), 12)
    return f"{value:.{digits}f}", f"{error:.{digits}f}"


def parameters(parameters: Any, errors: Mapping[str, float], units: Mapping[str, str]) -> None:
    """Print a table of parameters with their standard errors."""
    rows = [
        (name, *rounded(value, error), units.get(name, ""))
        for name, error in errors.items()
        if (value := getattr(parameters, name)) is not None
    ]
    print()
    table(("parameter", "value", "std. error", "unit"), rows, right=("value", "std. error"))


def grouped(number: int) -> str:
    """Format a number with spaces between its thousands."""
    return f"{number:,}".replace(",", " ")


def driver_text(device: Device | BackendInfo) -> str:
    """Describe a device's compiler: driver, lanes and target, such as ``PoCL 3.0, 16 lanes, skylake-avx512``."""
    from gpusense.backends import short_driver

    lanes = f"{device.lanes} lanes" if device.lanes > 1 else ""
    absent = "" if device.float64 or not device.driver else "no float64"
    return ", ".join(part for part in (short_driver(device.driver), lanes, device.target, absent) if part) or "-"
