"""Run the command line: ``gpusense devices``, ``gpusense demo`` and the other commands."""

from __future__ import annotations

import argparse
import contextlib
import difflib
import functools
import importlib
import io
import itertools
import os
import re
import sys
import textwrap
import warnings
from collections.abc import Callable, Iterator, Sequence
from types import ModuleType
from typing import Any, NoReturn

from gpusense._util.extras import explained
from gpusense._version import __version__
from gpusense.commands import arguments, scans, signals

# Modules of gpusense.commands, in the order of the help.
COMMANDS = (
    "devices", "selftest", "demo", "explain", "simulate", "map", "score", "localize", "judge", "fit", "match",
    "likelihood-map", "features", "landmarks", "ros", "sweep", "bench",
)  # fmt: skip
ALIASES = {"localise": "localize"}

# Options of many commands; the attribute ``SHARED`` of a command names them.
_SHARED: dict[str, Callable[[argparse.ArgumentParser], None]] = {
    "reference": scans.add_reference, "choice": scans.add_choice, "range": scans.add_range_max,
    "model": arguments.add_model, "parameters": arguments.add_parameters, "backend": arguments.add_backend,
    "seed": arguments.add_seed, "json": arguments.add_json,
    "verbose": functools.partial(arguments.add_json, verbose=True),
}  # fmt: skip
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
    """Parser that reports an error in one line."""

    _command: str | None = None

    def error(self, message: str) -> NoReturn:
        """Print the message with a likely correction instead of the usage, and exit."""
        self.exit(BAD_INPUT, _error_line(message + self._correction(message)))

    def _correction(self, message: str) -> str:
        """Return the name that an unknown command, choice or option resembles, or ""."""
        wrong = re.match(r"argument (\S+): invalid choice: '([^']*)'|unrecognized arguments: (-\S+)", message)
        if wrong is None:
            return ""
        name, choice, option = wrong.groups()
        parser = self
        if option:
            # The top-level parser reports the unknown options of commands.
            parser = self._commands().get(self._command or "", self)
            known: list[str] = [text for action in parser._actions for text in action.option_strings]
        elif name == "COMMAND":
            known = list(COMMANDS)
        else:
            actions = [
                action for action in self._actions if name.split("/")[0] in (*action.option_strings, action.dest)
            ]
            known = [str(choice) for action in actions for choice in action.choices or ()]
        close = difflib.get_close_matches(option or choice, known, n=1)
        return f"; did you mean {close[0]!r}?" if close else ""

    def _commands(self) -> dict[str, Parser]:
        """Return the parsers of commands by name."""
        actions = [action for action in self._actions if isinstance(action, argparse._SubParsersAction)]
        return actions[0].choices if actions else {}

    def parse_known_args(  # type: ignore[override]
        self, args: Any = None, namespace: Any = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """Parse arguments like the base class, and check that no output is another file of the command."""
        found, rest = super().parse_known_args(args, namespace)
        self._command = getattr(found, "command", None)
        self._check_outputs(found)
        return found, rest

    def _check_outputs(self, found: argparse.Namespace) -> None:
        """Report an output that would replace another output or an input."""
        values = [(action, getattr(found, action.dest, None)) for action in self._actions]
        files = [(action, os.path.realpath(value)) for action, value in values if isinstance(value, os.PathLike)]
        if not files:
            return
        for action, file in files:
            for other, same in files if isinstance(action.type, arguments.Output) else ():
                if other is not action and same == file:
                    name = other.option_strings[0]
                    self.error(
                        f"argument {action.option_strings[0]}: must be another file than that of {name}, got both"
                    )

    def group_options(self, first: Sequence[str]) -> None:
        """Put the options that one needs first into a group of the help, and shorten the usage to required ones."""
        options, group = self._optionals, self.add_argument_group("most used")
        actions = {action.dest: action for action in self._actions}
        for action in [actions[name] for name in first if actions[name] in options._group_actions]:
            options._group_actions.remove(action)
            group._group_actions.append(action)
        options.title = "further options" if first else "options"
        self._action_groups.remove(group)
        self._action_groups.insert(1, group)
        required = [action for action in self._actions if action.required or not action.option_strings]
        words = [
            f"{action.option_strings[0]} {action.metavar}" if action.option_strings
            else f"[{action.metavar}]" if action.nargs == "?" else str(action.metavar)
            for action in required
        ]  # fmt: skip
        self.usage = " ".join(["%(prog)s", *words, "[options]"])


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
    # Import only the chosen command: an import error in another command must not affect it.
    argv = [ALIASES.get(argv[0], argv[0]), *argv[1:]] if argv else argv
    names = (argv[0],) if argv and argv[0] in COMMANDS else COMMANDS
    parser = _build(names)
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
    return code


def _build(names: Sequence[str]) -> Parser:
    """Build the parser of these commands."""
    layout = Layout
    parser = Parser(
        prog="gpusense", description=_DESCRIPTION, epilog=_EPILOG, formatter_class=layout, allow_abbrev=False
    )
    parser.add_argument("--version", action="version", version=f"gpusense {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", title="commands")
    for name in names:
        module = importlib.import_module(f"gpusense.commands.{name.replace('-', '_')}")
        command = commands.add_parser(
            name, help=module.HELP, description=module.HELP, epilog=_epilog(module), formatter_class=layout,
            allow_abbrev=False,
        )  # fmt: skip
        module.add_arguments(command)
        for option in getattr(module, "SHARED", ()):
            _SHARED[option](command)
        command.group_options(module.FIRST)
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
