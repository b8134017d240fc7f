"""Define the options of commands and their types, and open what the options choose."""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gpusense as gs
from gpusense._util.extras import check_library
from gpusense._util.files import check_writable
from gpusense._util.typing import PRECISIONS

if TYPE_CHECKING:
    from gpusense.backends import Backend

BACKEND_HELP = (
    "device: auto (the fastest one present), gpu, cpu, cuda, numpy, opencl, opencl:<part of a name>, warp:cpu or "
    "warp:cuda:<number>; 'gpusense devices' lists them"
)

_LONGEST_RANGE = 10_000.0
# Library that writes files of a suffix, and the subject of the message if it is missing.
_PICTURE = ("matplotlib", "a picture")
_WRITERS = {".png": _PICTURE, ".pdf": _PICTURE, ".svg": _PICTURE, ".rrd": ("rerun", "a recording for Rerun")}


class Options:
    """Options of a command; those named in ``first`` lead the help.

    ``add("--step M", "distance between scans [m]", positive_number, 0.2)`` adds an option with one value, and states
    its default. "--start X Y THETA" has three values, "--topic NAME..." one or more, "--scene NAME*" may be repeated,
    "--quick" is a switch, and "PLAN" an argument without a name. A type may be a tuple of choices.
    """

    def __init__(self, parser: argparse.ArgumentParser, first: Sequence[str] = ()) -> None:
        self.usage = "%(prog)s"
        self._first = first
        titles = ("most used", "further options") if first else ("most used", "options")
        self._groups: list[Any] = [parser.add_argument_group(title) for title in titles]
        self._groups[1].add_argument("-h", "--help", action="help", help="show this help and exit")

    @contextlib.contextmanager
    def exclusive(self, *, first: bool = True, required: bool = False) -> Iterator[None]:
        """Make the options that are added meanwhile exclude each other."""
        before = self._groups
        self._groups = [before[not first].add_mutually_exclusive_group(required=required)] * 2
        yield
        self._groups = before

    def __call__(self, names: str, text: str, kind: Any = None, default: Any = None, **more: Any) -> None:
        """Add an option with its help, type and default; ``more`` are arguments of ``add_argument``."""
        flags = [word for word in names.split() if word.startswith("-")]
        values = [word.rstrip("*") for word in names.split() if not word.startswith("-") and word != "*"]
        if isinstance(kind, tuple):
            more["choices"] = kind
        elif not values and "action" not in more:
            more["action"] = "store_true"
        elif kind is not None:
            more["type"] = kind
        if names.endswith("..."):
            more["nargs"], values = "+", [values[0].removesuffix("...")]
        if names.endswith("*"):
            more["action"] = "append"
        if values:
            more.setdefault("metavar", values[0] if len(values) == 1 else tuple(values))
        if len(values) > 1:
            more.setdefault("nargs", len(values))
        if default is not None:
            more["default"] = default
            if "(default: " not in text and default not in ([], ()):
                shown = " ".join(f"{one:g}" for one in default) if isinstance(default, tuple) else default
                text += f" (default: {shown})"
        dest = more.pop("dest", (flags or values)[0].strip("-").replace("-", "_").lower())
        where = self._groups[dest not in self._first and bool(flags)]
        where.add_argument(*(flags or [dest]), help=text, **more, **({"dest": dest} if flags else {}))
        if not flags:
            self.usage += f" [{values[0]}]" if more.get("nargs") == "?" else f" {values[0]}"
        elif more.get("required"):
            self.usage += f" {flags[0]} {values[0]}"


def _json(add: Options, *, verbose: bool = False) -> None:
    with add.exclusive(first=False):
        add("--json", "print one JSON document, and nothing else, on standard output")
        if verbose:
            add("-v --verbose", "also print all details", dest="verbose")


def _model(add: Options, default: str = "beam") -> None:
    add("--model", "measurement model", ("beam", "field"), default)
    _beams(add)
    add("--precision", "precision", PRECISIONS, "float32")
    add("--parameters YAML", "a file with beam_model or likelihood_field, such as 'gpusense fit --out' writes", Path)
    add("--set NAME=VALUE...", "values of the model's parameters, such as sigma_hit=0.1 hit=student", default=[])


def _beams(add: Options) -> None:
    add("--beams B", "thin each scan evenly to B beams (default: all)", whole_number(low=1))


def add_backend(add: Options, default: str = "auto") -> None:
    """Add ``--backend``, one selection string; the library checks it on use."""
    add("--backend DEVICE", BACKEND_HELP, default=default)


def _range(add: Options) -> None:
    add("--range-max M", "readings of at least this are 'no return' [m] (default: the log's reading for 'no return')",
        range_number)  # fmt: skip
    add("--range-min M", "readings of a bag below this are missing [m] (default: the bag's value)", not_negative_number)


def _choice(add: Options, what: str = "scan") -> None:
    add("--every E", f"every E-th {what}, from --offset on; '--every 2 --offset 1' are the odd ones",
        whole_number(low=1), 1)  # fmt: skip
    add("--offset O", f"index of the first {what}", whole_number(low=0), 0)
    add("--limit S", "read at most S (default: all)", whole_number(low=1))
    _range(add)


# Options of many commands, by their names in the attribute ``SHARED`` of a command.
SHARED: dict[str, Callable[[Options], None]] = {
    "reference": lambda add: add(
        "--reference FILE", "a TUM trajectory with the poses of the robot at the times of the scans; scans without a "
        "pose are skipped (default: the logged poses)", Path,
    ),
    "choice": _choice, "pairs": lambda add: _choice(add, "scan or pair"), "range": _range, "beams": _beams,
    "model": _model, "field": lambda add: _model(add, "field"), "backend": add_backend,
    "seed": lambda add: add("--seed N", "seed; the same seed gives the same run", whole_number(low=0), 0),
    "json": _json, "verbose": lambda add: _json(add, verbose=True),
}  # fmt: skip


def open_backends(selections: Sequence[str] | None) -> tuple[list[Backend], list[str]]:
    """Open the distinct backends of selections, or all devices but simulators; also return the errors of the latter."""
    from gpusense.backends import get_backend

    if selections is not None:
        return list({backend.info.selection: backend for backend in map(get_backend, selections)}.values()), []
    opened, failures = [], []
    for device in gs.devices():
        if device.available and device.kind != "simulator":
            try:
                opened.append(get_backend(device.selection))
            except Exception as error:
                failures.append(f"{device.selection}: {type(error).__name__}: {error}")
    return opened, failures


def whole_number(*, low: int, high: int | None = None) -> Callable[[str], int]:
    """Make a type for ``add_argument``: an integer from ``low`` to ``high``, both included."""
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


def real_number(rule: str, keeps: Callable[[float], bool] = lambda number: True) -> Callable[[str], float]:
    """Make a type for ``add_argument``: a number that keeps a rule."""

    def convert(text: str) -> float:
        try:
            number = float(text)
        except ValueError:
            number = None
        if number is None or not keeps(number):
            raise argparse.ArgumentTypeError(f"must be {rule}, got {text!r}")
        return number

    return convert


number = real_number("a number")
finite_number = real_number("a finite number", math.isfinite)
positive_number = real_number("a finite number > 0", lambda number: 0 < number < math.inf)
not_negative_number = real_number("a finite number >= 0", lambda number: 0 <= number < math.inf)
range_number = real_number(
    f"a number > 0 and <= {_LONGEST_RANGE:g} (metres)", lambda number: 0 < number <= _LONGEST_RANGE
)


def quantity(units: Mapping[str, tuple[str, float]]) -> Callable[[str], tuple[str, float]]:
    """Make a type for ``add_argument``: a number > 0 with a unit, which maps to a base unit and a factor."""

    def convert(text: str) -> tuple[str, float]:
        found = re.fullmatch(r"\s*((?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([a-z%]+)\s*", text)
        if found is None or found[2] not in units or not 0 < float(found[1]) < math.inf:
            raise argparse.ArgumentTypeError(f"must be a number > 0 with a unit of {', '.join(units)}, got {text!r}")
        unit, factor = units[found[2]]
        return unit, factor * float(found[1])

    return convert


class Output:
    """A type of option: an output of the command; a file of one of some suffixes is checked before any work."""

    def __init__(self, *suffixes: str) -> None:
        self._suffixes = suffixes

    def __call__(self, text: str) -> Path:
        """Convert an argument to a path."""
        path = Path(text)
        if self._suffixes and path.suffix.lower() not in self._suffixes:
            raise argparse.ArgumentTypeError(f"must end in {' or '.join(self._suffixes)}, got {text!r}")
        if self._suffixes:
            _check_target(text, path, path.suffix.lower(), "must be a file that can be written")
        return path


picture, csv_file, tum_file = Output(".png", ".pdf", ".svg"), Output(".csv"), Output(".tum", ".txt")


def output_folder(*suffixes: str) -> Callable[[str], Path]:
    """Make a type of option: a folder that can be written to, or created after the work, for files of some suffixes."""

    def convert(text: str) -> Path:
        folder, rule = Path(text), "must be a folder that can be written to"
        there = next(each for each in (folder, *folder.absolute().parents) if os.path.lexists(each))
        if not there.is_dir():
            raise argparse.ArgumentTypeError(f"{rule}, got {text!r}: not a folder")
        for suffix in suffixes or ("",):
            _check_target(text, there / "new", suffix, rule)
        return folder

    return convert


def _check_target(text: str, path: Path, suffix: str, rule: str) -> None:
    """Check that a file can be written, and that the library for its suffix is installed."""
    try:
        if suffix in _WRITERS:
            check_library(*_WRITERS[suffix])
        check_writable(path)
    except ImportError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise argparse.ArgumentTypeError(f"{rule}, got {text!r}: {reason}") from None


def temperature(text: str) -> float | str:
    """Convert an argument to a positive number or "auto"."""
    return text if text == "auto" else positive_number(text)


def refuse(args: argparse.Namespace, names: Iterable[str], rule: str) -> None:
    """Refuse options that the user set; ``names`` are attributes of ``args``."""
    for name in names:
        value = getattr(args, name)
        if value is not None and value is not False:
            option = {"odometry_from": "odometry", "anywhere": "global"}.get(name, name.replace("_", "-"))
            raise ValueError(f"--{option}: {rule}, got {'it' if value is True else value}")


def parameters_of(args: argparse.Namespace) -> gs.BeamParameters | gs.LikelihoodFieldParameters:
    """Return the parameters of the model that the options choose."""
    from gpusense.commands.parameter_files import read_parameters

    values: gs.BeamParameters | gs.LikelihoodFieldParameters
    values = gs.BeamParameters() if args.model == "beam" else gs.LikelihoodFieldParameters.tracking()
    if args.parameters is not None:
        values = read_parameters(args.parameters, "beam_model" if args.model == "beam" else "likelihood_field")
    changes: dict[str, float | str] = {}
    for name, equals, text in (word.partition("=") for word in args.set):
        if not equals:
            raise ValueError(f"--set: must be NAME=VALUE, got {name}")
        try:
            changes[name] = float(text)
        except ValueError:
            changes[name] = text
    return values.replace(**changes)


def scan_model(
    args: argparse.Namespace, grid: gs.OccupancyGrid, scanner: gs.Scanner, **options: Any
) -> gs.BeamModel | gs.LikelihoodFieldModel:
    """Make the model that ``--model``, its parameters, ``--precision``, ``--beams`` and ``--backend`` choose."""
    parameters = parameters_of(args)
    options |= {"backend": args.backend, "precision": args.precision, "beams": args.beams}
    if isinstance(parameters, gs.BeamParameters):
        return gs.BeamModel(grid, scanner, parameters, **options)
    return gs.LikelihoodFieldModel(grid, scanner, parameters, **options)
