"""Warnings of backends, one line each; the choice of the default device holds them back until it is made."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Iterator

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
