"""Handle signals that end a command with its results so far, a one-line report and no partial file.

Ctrl-C, a hang-up of the terminal, and the signal of containers and ``timeout`` raise exceptions. Only the command line
installs handlers, in the main thread, and restores the old ones.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sized
from types import FrameType
from typing import Any

from gpusense._util import interrupts
from gpusense._util.progress import progress

# Signals that ended the work of this command.
HELD: list[KeyboardInterrupt] = []
# Signals that end a command, and words for the end. Signals ignored by the caller, as by nohup, stay ignored.
_WORDS = {name: word for name, word in (("SIGINT", "interrupted"), ("SIGTERM", "terminated"), ("SIGHUP", "hung up"))
          if hasattr(signal, name)}  # fmt: skip


class Stopped(KeyboardInterrupt):
    """Signal that requests the end of the command."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def code_of(stop: KeyboardInterrupt) -> int:
    """Return the exit code of a stopped command: 128 plus the number of the signal, as in a shell."""
    return 128 + (stop.number if isinstance(stop, Stopped) else signal.SIGINT)


def word_of(stop: KeyboardInterrupt) -> str:
    """Return "interrupted" or the word for another signal."""
    return _WORDS[signal.Signals(code_of(stop) - 128).name]


@contextlib.contextmanager
def stopping() -> Iterator[None]:
    """Turn signals that end a command into :class:`Stopped`, in the main thread only.

    Python ignores exceptions in destructors and callbacks; a signal that arrives there is delivered again.
    """
    HELD.clear()
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    process = os.getpid()

    def stop(number: int, frame: FrameType | None) -> None:
        if os.getpid() != process:
            # A forked child ends as if there were no handler.
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
            return
        raise Stopped(number)

    def report_unraisable(lost: Any) -> None:
        if issubclass(lost.exc_type, KeyboardInterrupt):
            interrupts.deliver_later(code_of(lost.exc_value) - 128)
        else:
            before_hook(lost)

    before_hook = sys.unraisablehook
    # A program that calls the command line may have installed handlers.
    usual = (signal.SIG_DFL, signal.default_int_handler)
    numbers = [number for name in _WORDS if signal.getsignal(number := getattr(signal, name)) in usual]
    before = {}
    try:
        sys.unraisablehook = report_unraisable
        for number in numbers:
            before[number] = signal.signal(number, stop)
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        sys.unraisablehook = before_hook


@contextlib.contextmanager
def working(results: Sized, total: int) -> Iterator[Callable[[str], None]]:
    """Show the progress of ``total`` steps; hold back a signal that ends them, but not without results.

    Yields the function that begins a step. :func:`raise_held` raises the signal after the report of the results.
    """
    with progress(total) as step:
        try:
            yield step
        except KeyboardInterrupt as stop:
            if not len(results):
                raise
            HELD.append(stop)


def raise_held() -> None:
    """Raise the signal that was held back, if any."""
    if HELD:
        raise HELD[0]


@contextlib.contextmanager
def ending() -> Iterator[None]:
    """Ignore further signals for the last line of a command."""
    numbers = [getattr(signal, name) for name in _WORDS]
    main = threading.current_thread() is threading.main_thread()
    before = {number: signal.signal(number, signal.SIG_IGN) for number in numbers} if main else {}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
