"""Warn at the user's line of code, from any depth of this package."""

from __future__ import annotations

import contextlib
import logging
import sys
import threading
import warnings
from collections.abc import Iterator

_PACKAGE = __name__.partition(".")[0] + "."


def warn_user(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn at the nearest frame outside this package, so that Python shows a message once per calling line."""
    level, frame = 2, sys._getframe(1)
    while frame.f_back is not None and f"{frame.f_globals.get('__name__')}.".startswith(_PACKAGE):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)


# ---- warnings of backends, one line each; the choice of the default device holds them back until it is made


_LOG = logging.getLogger("gpusense")
_thread = threading.local()


def warn(text: str) -> None:
    """Log a warning, or hold it back where this thread does."""
    held: list[str] | None = getattr(_thread, "held", None)
    if held is None:
        _LOG.warning("gpusense: %s", text)
    else:
        held.append(text)


@contextlib.contextmanager
def held() -> Iterator[list[str]]:
    """Hold back this thread's warnings and yield their list; warnings left in the list are logged on exit."""
    before: list[str] | None = getattr(_thread, "held", None)
    lines: list[str] = []
    _thread.held = lines
    try:
        yield lines
    finally:
        _thread.held = before
        for line in lines:
            warn(line)
