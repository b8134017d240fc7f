"""Change a filter's state on the host atomically, and copy it to and from plain data.

Python may raise KeyboardInterrupt between any two lines. A call that changes a filter first saves all attributes in a
journal, and at its end drops the journal by one assignment. After an interrupt the journal restores the attributes at
once or, if a second interrupt prevents that, before the next call. Buffers on a device need no copy, since a step
writes only buffers that no attribute names yet.

A class lists its state in ``MEMORY``. Values of attributes are replaced, never changed: arrays, dictionaries and
objects too.
"""

from __future__ import annotations

import copy
import functools
import sys
import threading
from collections.abc import Callable, Iterable, Mapping
from types import FrameType
from typing import Any, Concatenate, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


class Journal:
    """The complete state of objects at one moment, and the call that may change them."""

    __slots__ = ("_objects", "frame")

    def __init__(self, owners: Iterable[Any], frame: FrameType | None = None) -> None:
        # Faster than choosing attributes, which ``restore`` does. The frame refers back to this object.
        self.frame, self._objects = frame, [(one, one.__dict__.copy()) for one in owners]

    def is_running(self) -> bool:
        """Return whether the present call is within the journal's call."""
        frame: FrameType | None = sys._getframe(1)
        while frame is not None:
            if frame is self.frame:
                return True
            frame = frame.f_back
        return False

    def restore(self) -> None:
        """Restore everything; an interrupted restoration is repeated."""
        for one, values in self._objects:
            one.__dict__.update({name: values[name] for name in one.MEMORY})


class Transactional:
    """Base class of objects with atomic calls, serialised over threads."""

    _journal: Journal | None = None

    def _begin_journals(self) -> None:
        """Prepare the object for :func:`atomic` calls."""
        self._calls = threading.RLock()

    def _changing(self) -> tuple[Any, ...]:
        """Return all objects that a call may change: this one and its parts; called when a call begins."""
        return (self,)

    def settle(self) -> None:
        """Restore the state after an interrupted call."""
        if self._journal is not None and not self._journal.is_running():
            self._journal.restore()
            self._journal = None


W = TypeVar("W", bound=Transactional)


def atomic(method: Callable[Concatenate[W, P], R]) -> Callable[Concatenate[W, P], R]:
    """Make a method atomic: if it raises, the object's state is unchanged."""

    @functools.wraps(method)
    def call(self: W, /, *args: P.args, **kwargs: P.kwargs) -> R:
        with self._calls:
            if self._journal is not None:
                self.settle()
            if self._journal is not None:
                # A call within an atomic call.
                return method(self, *args, **kwargs)
            journal = self._journal = Journal(self._changing(), sys._getframe())
            try:
                result = method(self, *args, **kwargs)
                self._journal = None
                return result
            except BaseException:
                journal.restore()
                self._journal = None
                raise
            finally:
                journal.frame = None

    return call


def consistent(method: Callable[Concatenate[W, P], R]) -> Callable[Concatenate[W, P], R]:
    """Settle the state before a method that changes state only through :func:`atomic` methods."""

    @functools.wraps(method)
    def call(self: W, /, *args: P.args, **kwargs: P.kwargs) -> R:
        with self._calls:
            if self._journal is not None:
                self.settle()
            return method(self, *args, **kwargs)

    return call


# ---- plain data


def plain_state(owner: Any) -> dict[str, Any]:
    """Return a copy of the state of an object, plain data that pickles and holds no device."""
    return copy.deepcopy({name: getattr(owner, name) for name in owner.MEMORY})


def set_state(owner: Any, values: Mapping[str, Any]) -> None:
    """Set the state of an object from a copy of the result of ``plain_state``."""
    for name, value in values.items():
        setattr(owner, name, copy.deepcopy(value))
