"""Run the command line: ``gpusense devices``, ``gpusense demo`` and the other commands."""

from __future__ import annotations

import argparse
import atexit
import contextlib
import difflib
import gc
import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import io
import itertools
import os
import re
import sys
import textwrap
import warnings
from collections.abc import Iterable, Iterator, Sequence
from types import ModuleType
from typing import Any, NoReturn

from gpusense._util.extras import explained
from gpusense._version import __version__
from gpusense.commands import arguments, signals

# Modules of gpusense.commands with their help, in its order.
COMMANDS = {
    "devices": "List the devices, with a remedy for each that is absent.",
    "selftest": "Check that the backends agree with the float64 truth.",
    "demo": "Localise a robot in a generated building on every device.",
    "explain": "Report what the kernels leave out for a scene, and why.",
    "simulate": "Make the log of a robot that drives through a map.",
    "map": "Build an occupancy grid from the scans of a log.",
    "score": "Rank the logged poses of a log among particles.",
    "localize": "Localise a robot along a log with a particle filter.",
    "judge": "Judge the poses of any localiser: when right, when lost.",
    "fit": "Fit the beam model's parameters to a log, or to pairs.",
    "match": "Match the scans of a log to each other, or to a map.",
    "likelihood-map": "Draw the likelihood of a scan over all poses of a map.",
    "features": "Extract lines, corners, doors and poles from scans.",
    "landmarks": "Fit, check and localise a recorded run among landmarks.",
    "ros": "Localise inside ROS 2, or watch another localiser.",
    "sweep": "Run many jobs from a plan into one table.",
    "bench": "Name the fastest method within an error or a time.",
}
ALIASES = {"localise": "localize"}

# Meanings of the exit codes where a command states none.
_CODES = {0: "success", 2: "bad input", 130: "interrupted", 143: "terminated"}
BAD_INPUT = 2
BROKEN_PIPE = 141
# Environment variable that lets exceptions through with their traceback, for developers.
TRACEBACK = "GPUSENSE_TRACEBACK"

_DESCRIPTION = """\
Probabilistic range-sensor models p(z | x, m) for mobile robots, on any vendor's GPU.
How likely is this scan, if the robot stands here? For thousands of poses at once."""

_EPILOG = """\
start here:
  gpusense demo               localise a robot in a generated building, and draw the result
  gpusense devices            list the devices, and the remedy for each that is absent
  gpusense COMMAND --help     describe a command and its options, with examples

Completion of commands and options by TAB: pip install 'gpusense[completion]', and in ~/.bashrc or ~/.zshrc
  eval "$(register-python-argcomplete gpusense)"

Exit codes: 0 success, 1 a negative result such as 'lost' (see the command's help), 2 bad input (described in
one line on standard error), 130 interrupted (Ctrl-C), 143 terminated. A command that is interrupted or terminated
keeps and prints the results so far."""


class Parser(argparse.ArgumentParser):
    """Parser that reports an error in one line, and takes negative numbers with exponents, such as -1e-3."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        # The pattern of argparse lacks exponents before Python 3.14.
        self._negative_number_matcher = re.compile(r"-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")

    def error(self, message: str) -> NoReturn:
        """Print the message with a likely correction instead of the usage, and exit."""
        choice = re.search(r"invalid choice: '([^']*)' \(choose from (.*)\)", message)
        wrong = choice or re.match(r"unrecognized arguments: -+([^\s=-][^\s=]*)", message)
        names = [name for action in self._actions for name in action.option_strings]
        known = {name.lstrip("-"): name for name in (re.findall(r"[\w-]+", choice[2]) if choice else names)}
        close = difflib.get_close_matches(wrong[1], known, n=1) if wrong else []
        self.exit(BAD_INPUT, _error_line(message + (f"; did you mean {known[close[0]]!r}?" if close else "")))

    def parse_known_args(  # type: ignore[override]
        self, args: Any = None, namespace: Any = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """Parse arguments like the base class; refuse unknown ones, and an output that is another of its files."""
        found, rest = super().parse_known_args(args, namespace)
        if rest:
            self.error(f"unrecognized arguments: {' '.join(rest)}")
        values = [(action, getattr(found, action.dest, None)) for action in self._actions]
        files = [(action, os.path.realpath(value)) for action, value in values if isinstance(value, os.PathLike)]
        for action, file in files:
            for other, same in files if isinstance(action.type, arguments.Output) else ():
                if other is not action and same == file:
                    rule = f"must be another file than that of {other.option_strings[0]}, got both"
                    self.error(f"argument {action.option_strings[0]}: {rule}")
        return found, rest


class _Postponed(importlib.abc.MetaPathFinder):
    """Finder that postpones the execution of library modules until their first use; help executes few modules."""

    def find_spec(self, fullname: str, path: Any, target: Any = None) -> importlib.machinery.ModuleSpec | None:
        """Return the specification of a module outside the commands."""
        if not fullname.startswith("gpusense.") or fullname.startswith("gpusense.commands."):
            return None
        spec = importlib.machinery.PathFinder.find_spec(fullname, path, target)
        if spec is None or spec.loader is None or spec.submodule_search_locations is not None:
            return None
        spec.loader = importlib.util.LazyLoader(spec.loader)
        return spec

    def __enter__(self) -> None:
        sys.meta_path.insert(0, self)

    def __exit__(self, *_: object) -> None:
        sys.meta_path.remove(self)


class Layout(argparse.RawDescriptionHelpFormatter):
    """Help with texts whose indented lines stay, and a column wide enough for indented command names."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        """Wrap the paragraphs of a text, and keep its indented lines."""
        lines: list[str] = []
        for verbatim, block in itertools.groupby(text.splitlines(), lambda line: not line[:1].strip()):
            part = list(block)
            lines += part if verbatim else textwrap.wrap(" ".join(part), width)
        return "\n".join(indent + line for line in lines)

    def add_argument(self, action: argparse.Action) -> None:
        """Add an argument to the help."""
        super().add_argument(action)
        if action.dest == "command" and action.choices is not None:
            longest = max(len(str(name)) for name in action.choices)
            self._action_max_length = max(self._action_max_length, self._current_indent + 2 + longest)


@contextlib.contextmanager
def _short_warnings() -> Iterator[None]:
    """Print each warning once, in one line, without its source location.

    Python forgets its shown warnings when a library changes the filters, as some libraries do on import.
    """
    shown: set[tuple[str, type[Warning]]] = set()

    def line(message: Warning | str, *_: object, **__: object) -> str:
        return f"gpusense: warning: {' '.join(str(message).split())}\n"

    def show(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
        if (key := (str(message), category)) not in shown:
            shown.add(key)
            show_before(message, category, *place, **more)

    before, show_before = warnings.formatwarning, warnings.showwarning
    warnings.formatwarning, warnings.showwarning = line, show
    try:
        yield
    finally:
        warnings.formatwarning, warnings.showwarning = before, show_before


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    ``argv``: Arguments after the program's name; ``sys.argv[1:]`` by default.

    Returns:
        The exit code: 0 success, 2 bad input, 130 interrupted, 143 terminated, 129 after a hang-up of the terminal,
        141 after the reader of standard output has gone, or a code of the command.
    """
    if argv is None:
        # At its end, Python would look for cycles among all objects of the libraries, which can take a second.
        atexit.register(gc.freeze)
    _open_closed_streams()
    for stream in (sys.stdout, sys.stderr):
        # Device names may contain characters outside the terminal's encoding.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        with signals.stopping(), _short_warnings():
            code = _dispatch(list(sys.argv[1:] if argv is None else argv))
            print(end="", flush=True)
        return code
    except BrokenPipeError:
        _settle()
        return BROKEN_PIPE
    except KeyboardInterrupt as stop:
        with signals.ending(), contextlib.suppress(OSError):
            _settle()
            sys.stderr.write(f"gpusense: {signals.word_of(stop)}\n")
        return signals.code_of(stop)
    except (ValueError, TypeError, OSError, MemoryError) as error:
        return _failed(error)
    except ImportError as error:
        absent = explained(error)
        if absent is None:
            raise
        return _failed(absent)


def _open_closed_streams() -> None:
    """Discard output to a stream that the caller closed, as by ``>&-``; Python sets it to None."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115


def _failed(error: Exception) -> int:
    """Print an error in one line, with its traceback if the environment requests it."""
    if os.environ.get(TRACEBACK):
        raise error
    _settle()
    sys.stderr.write(_error_line(_message(error)))
    return BAD_INPUT


def _settle() -> None:
    """Flush standard output, and redirect it on failure, so that Python's flush at exit succeeds."""
    try:
        print(end="", flush=True)
    except (OSError, ValueError):
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _dispatch(argv: list[str]) -> int:
    argv = [ALIASES.get(argv[0], argv[0]), *argv[1:]] if argv else argv
    # Import only the chosen command: an import error in another command must not affect it.
    parser = _build([name for name in (*argv[:1], *os.environ.get("COMP_LINE", "").split()[1:2]) if name in COMMANDS])
    if "_ARGCOMPLETE" in os.environ:
        import argcomplete

        argcomplete.autocomplete(parser)
    try:
        args = parser.parse_args(argv)
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else BAD_INPUT
    if args.command is None:
        parser.print_help()
        return 0
    code: int = args.run(args)
    signals.raise_held()
    return code


def _build(loaded: Iterable[str]) -> Parser:
    """Build the parser with the options of some commands."""
    parser = Parser(
        prog="gpusense", description=_DESCRIPTION, epilog=_EPILOG, formatter_class=Layout, allow_abbrev=False
    )
    parser.add_argument("--version", action="version", version=f"gpusense {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", title="commands")
    for name, text in COMMANDS.items():
        command = commands.add_parser(
            name, help=text, description=text, formatter_class=Layout, allow_abbrev=False, add_help=False
        )
        if name in loaded:
            with _Postponed():
                module = importlib.import_module(f"gpusense.commands.{name.replace('-', '_')}")
            command.description, command.epilog = getattr(module, "DESCRIPTION", text), _epilog(module)
            add = arguments.Options(command, module.FIRST)
            module.add_options(add)
            for option in module.SHARED:
                arguments.SHARED[option](add)
            command.usage = f"{add.usage} [options]"
            command.set_defaults(run=module.run)
    return parser


def _epilog(module: ModuleType) -> str:
    """Return the text below a command's options: its notes, exit codes and examples."""
    notes, _, examples = module.EPILOG.partition("examples:")
    codes = _CODES | getattr(module, "CODES", {})
    text = ", ".join(f"{code} {codes[code]}" for code in sorted(codes))
    return f"{notes}Exit codes: {text}.\n\nexamples:{examples}"


def _message(error: Exception) -> str:
    """Return an exception's message, without error numbers of the operating system."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename is not None else error.strerror
    if isinstance(error, MemoryError) and not str(error):
        return "out of memory"
    return str(error) or type(error).__name__


def _error_line(message: str) -> str:
    return f"gpusense: error: {' '.join(message.split())}\n"
