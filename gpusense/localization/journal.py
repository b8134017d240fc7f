"""Change a filter's state on the host atomically, and copy it to and from plain data.

Python may raise KeyboardInterrupt between any two lines. A call that changes a filter first saves all attributes in a
journal, and at its end drops the journal by one assignment. After an interrupt the journal restores the attributes at
once or, if a second interrupt prevents that, before the next call. Buffers on a device need no copy, since a step
writes only buffers that no attribute names yet.

A class lists its state in ``MEMORY``; without it all attributes are state. Values of attributes are replaced, never
changed: arrays, dictionaries and objects too.
"""

from __future__ import annotations

import copy
import functools
import sys
import threading
from collections.abc import Callable, Collection, Iterable, Mapping
from types import FrameType
from typing import Any, Concatenate, NamedTuple, ParamSpec, TypeVar

import numpy as np

_PLAIN = (type(None), bool, int, float, str, np.generic)

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
            names = getattr(one, "MEMORY", values)
            one.__dict__.update({name: values[name] for name in names if name in values})


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


class Held(NamedTuple):
    """Attributes of an object within a state, to set on a copy of the present object."""

    values: dict[str, Any]


def plain_state(owner: Any, *, without: Collection[str] = ()) -> dict[str, Any]:
    """Return the state of an object, without some attributes, as plain data that pickles and holds no device."""
    names = getattr(owner, "MEMORY", vars(owner))
    return {name: _plain(getattr(owner, name)) for name in names if name not in without}


def _plain(value: Any) -> Any:
    """Return a copy of a value as plain data."""
    kind = type(value)
    if isinstance(value, np.ndarray):
        return value.copy()
    if isinstance(value, _PLAIN):
        return value
    if kind is dict:
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, tuple):
        items = [_plain(item) for item in value]
        return tuple(items) if kind is tuple else kind(*items)
    if kind.__module__.startswith("gpusense.localization.") and hasattr(value, "__dict__"):
        return Held(plain_state(value))
    raise TypeError(f"state: must be plain data, got {kind}")


def set_state(owner: Any, values: Mapping[str, Any]) -> None:
    """Set the state of an object from the result of ``plain_state``."""
    for name, value in values.items():
        if isinstance(value, Held):
            changed = copy.copy(getattr(owner, name))
            set_state(changed, value.values)
            setattr(owner, name, changed)
        else:
            setattr(owner, name, copy.copy(value) if isinstance(value, (np.ndarray, dict)) else value)
