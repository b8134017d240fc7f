"""Define options and value types for several commands, and open the backends of ``--backend``."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gpusense._util.extras import check_library
from gpusense._util.files import check_writable
from gpusense._util.typing import PRECISIONS
from gpusense.localization.defaults import DEFAULTS

if TYPE_CHECKING:
    from gpusense.backends import Backend
    from gpusense.models.scan.beam import BeamModel
    from gpusense.models.scan.field import LikelihoodFieldModel
    from gpusense.world.grid import OccupancyGrid
    from gpusense.world.parameters import BeamParameters, LikelihoodFieldParameters
    from gpusense.world.scanner import Scanner

BACKEND_HELP = (
    "device: auto (the fastest one present), gpu, cpu, cuda, numpy, opencl, opencl:<part of a name>, warp:cpu or "
    "warp:cuda:<number>; 'gpusense devices' lists them"
)

_LONGEST_RANGE = 10_000.0
# Library that writes files of a suffix, and the subject of the message if it is missing.
_PICTURE = ("matplotlib", "a picture")
_WRITERS = {".png": _PICTURE, ".pdf": _PICTURE, ".svg": _PICTURE, ".rrd": ("rerun", "a recording for Rerun")}
_SHARED = ("z_hit", "z_max", "z_rand", "sigma_hit", "hit", "hit_dof")
_SPECIFIC = {"beam": ("z_short", "lambda_short"), "field": ("max_distance", "interpolation")}
_MEANING = {
    "z_hit": "weight of a correct range with noise",
    "z_max": "weight of 'no return'",
    "z_rand": "weight of a random reading; the weights must sum to 1",
    "sigma_hit": "deviation of a correct range, or of an end point from a wall [m]",
    "hit_dof": "degrees of freedom of --hit student, 1 to 1e6",
    "z_short": "weight of an unexpected obstacle; beam model only",
    "lambda_short": "rate of unexpected obstacles along a beam [1/m]; beam model only",
    "max_distance": "largest distance to an obstacle that counts [m]; field only",
}


def add_backend(parser: argparse.ArgumentParser, *, default: str = "auto") -> None:
    """Add ``--backend``, one selection string; the library checks it on use."""
    parser.add_argument("--backend", default=default, metavar="DEVICE", help=f"{BACKEND_HELP} (default: %(default)s)")


def add_temperature(parser: argparse.ArgumentParser, automatic: str) -> None:
    """Add ``--temperature``: a number, or ``DEFAULTS.temperature``, explained by ``automatic``."""
    parser.add_argument(
        "--temperature", type=_temperature, default=DEFAULTS.temperature, metavar="T",
        help=f"factor of log-likelihoods in (0, 1], or {automatic} (default: %(default)s)",
    )  # fmt: skip


def _temperature(text: str) -> float | str:
    return text if text == "auto" else positive_number(text)


def add_json(parser: argparse.ArgumentParser, *, verbose: bool = False) -> None:
    """Add ``--json``, and as its alternative ``--verbose`` where the command has more to print."""
    group = parser.add_mutually_exclusive_group()
    group.add_argument(
        "--json", action="store_true", help="print one JSON document, and nothing else, on standard output"
    )
    if verbose:
        group.add_argument("-v", "--verbose", action="store_true", help="also print all details")


def add_seed(parser: argparse.ArgumentParser) -> None:
    """Add ``--seed``, an integer >= 0 for ``numpy.random.default_rng``."""
    parser.add_argument(
        "--seed", type=whole_number(low=0), default=0, metavar="N",
        help="seed of the random numbers: the same seed gives the same run (default: %(default)s)",
    )  # fmt: skip


def open_backends(selections: Sequence[str] | None) -> tuple[list[Backend], list[str]]:
    """Open the distinct backends of selections, or all devices but simulators; also return the errors of the latter."""
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


class Output:
    """A type for ``add_argument``: a file to write, different from the command's other files."""

    def __init__(self, convert: Callable[[str], Path] = Path) -> None:
        self._convert = convert

    def __call__(self, text: str) -> Path:
        """Convert an argument to a path."""
        return self._convert(text)


def output_path(*suffixes: str) -> Output:
    """Make a type for ``add_argument``: a file of one of some suffixes that can be written, checked before any work."""

    def convert(text: str) -> Path:
        path = Path(text)
        if suffixes and path.suffix.lower() not in suffixes:
            raise argparse.ArgumentTypeError(f"must end in {' or '.join(suffixes)}, got {text!r}")
        check_writer(path.suffix.lower())
        try:
            check_writable(path)
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) and error.strerror else error
            raise argparse.ArgumentTypeError(f"must be a file that can be written, got {text!r}: {reason}") from None
        return path

    return Output(convert)


def output_folder(*suffixes: str) -> Callable[[str], Path]:
    """Make a type for ``add_argument``: a folder that can be written to, or created, for files of some suffixes."""

    def convert(text: str) -> Path:
        folder = Path(text)
        for suffix in suffixes:
            check_writer(suffix)
        try:
            # The folder is created after the work.
            there = next(each for each in (folder, *folder.absolute().parents) if os.path.lexists(each))
            if not there.is_dir():
                raise ValueError("not a folder")
            check_writable(there / "new")
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) and error.strerror else error
            rule = "must be a folder that can be written to"
            raise argparse.ArgumentTypeError(f"{rule}, got {text!r}: {reason}") from None
        return folder

    return convert


def check_writer(suffix: str) -> None:
    """Check that the library for writing files of a suffix is installed."""
    if suffix not in _WRITERS:
        return
    try:
        check_library(*_WRITERS[suffix])
    except ImportError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def add_model(parser: argparse.ArgumentParser, default: str = "beam") -> None:
    """Add ``--model``, ``--precision`` and ``--beams``."""
    add = parser.add_argument
    add("--model", choices=("beam", "field"), default=default, help="measurement model (default: %(default)s)")
    add("--beams", type=whole_number(low=1), metavar="B", help="thin each scan evenly to B beams (default: all)")
    add("--precision", choices=PRECISIONS, default="float32", help="precision (default: %(default)s)")


def add_parameters(parser: argparse.ArgumentParser) -> None:
    """Add the group of the model's parameters."""
    from gpusense.world.hit_shapes import SHAPES

    group = parser.add_argument_group("parameters of the model")
    group.add_argument("--parameters", "--params", type=Path, metavar="YAML",
        help="a file with beam_model, such as 'gpusense fit --out' writes; beam model only")  # fmt: skip
    for name, meaning in _MEANING.items():
        group.add_argument(_option(name), type=number, metavar="X", help=meaning)
    group.add_argument("--hit", choices=tuple(SHAPES), help="shape of a correct range")
    group.add_argument("--interpolation", choices=("nearest", "bilinear"), help="look-up of the field; field only")


def parameters_of(args: argparse.Namespace) -> BeamParameters | LikelihoodFieldParameters:
    """Return the parameters of the model that the options choose."""
    from gpusense.world.parameters import BeamParameters, LikelihoodFieldParameters

    options = {name: getattr(args, name) for name in (*_SHARED, *_SPECIFIC["beam"], *_SPECIFIC["field"])}
    changes = {name: value for name, value in options.items() if value is not None}
    for name in changes:
        if name not in (*_SHARED, *_SPECIFIC[args.model]):
            raise ValueError(f"{_option(name)}: must be a parameter of the {args.model} model, got another model's")
    if args.model == "field":
        if args.parameters is not None:
            raise ValueError(f"--parameters: must be left out with the field, got {args.parameters}")
        return LikelihoodFieldParameters.tracking().replace(**changes)
    beam = BeamParameters()
    if args.parameters is not None:
        from gpusense.commands.parameter_files import read_beam_parameters

        beam = read_beam_parameters(args.parameters)
    return beam.replace(**changes)


def scan_model(
    args: argparse.Namespace, grid: OccupancyGrid, scanner: Scanner, **options: Any
) -> BeamModel | LikelihoodFieldModel:
    """Make the model that ``--model``, its parameters, ``--precision``, ``--beams`` and ``--backend`` choose."""
    from gpusense.models.scan.beam import BeamModel
    from gpusense.models.scan.field import LikelihoodFieldModel
    from gpusense.world.parameters import BeamParameters

    parameters = parameters_of(args)
    options |= {"backend": args.backend, "precision": args.precision, "beams": args.beams}
    if isinstance(parameters, BeamParameters):
        return BeamModel(grid, scanner, parameters, **options)
    return LikelihoodFieldModel(grid, scanner, parameters, **options)


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"
