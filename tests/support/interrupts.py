"""Interrupts at a chosen line: Ctrl-C between any two lines of the library."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import gpusense

_LIBRARY = str(Path(gpusense.__file__).parent)

Line = tuple[CodeType, int]
"""A line of a function."""


def _interruptible(frame: FrameType | None) -> bool:
    """Return whether a call is not part of ``__del__``, where Python catches all errors."""
    while frame is not None:
        if frame.f_code.co_name == "__del__":
            return False
        frame = frame.f_back
    return True


def executed_lines(call: Callable[[], Any]) -> list[Line]:
    """Return the distinct lines of the library that a call executes, in order of first execution."""
    lines: dict[Line, None] = {}

    def local(frame: FrameType, event: str, _: object) -> Any:
        if event == "line" and _interruptible(frame):
            lines.setdefault((frame.f_code, frame.f_lineno))
        return local

    before = sys.gettrace()
    sys.settrace(lambda frame, *_: local if frame.f_code.co_filename.startswith(_LIBRARY) else None)
    try:
        call()
    finally:
        sys.settrace(before)
    return list(lines)


def interrupt(call: Callable[[], Any], line: Line) -> bool:
    """Run a call, raise KeyboardInterrupt before its first execution of a line, and return whether that happened."""
    code, number = line
    raised = []

    def local(frame: FrameType, event: str, _: object) -> Any:
        if event == "line" and frame.f_lineno == number and not raised and _interruptible(frame):
            raised.append(line)
            raise KeyboardInterrupt
        return local

    before = sys.gettrace()
    sys.settrace(lambda frame, *_: local if frame.f_code is code else None)
    try:
        call()
    except KeyboardInterrupt:
        assert raised, "an interrupt from elsewhere"
    finally:
        sys.settrace(before)
    return bool(raised)
