"""State of a filter on the host: it changes as a whole or not at all, and is copied to and from plain data.

Python may raise KeyboardInterrupt between any two lines. A call that changes a filter first keeps all of the filter's
attributes in a journal, and drops it at its end by one assignment. If the call does not come to its end, the journal
puts the attributes back, at once or, if another interrupt prevents that, before the next call. What is on a device
needs no copy: a step writes buffers that the attributes do not name yet.

State are the attributes in ``MEMORY`` of a class; of classes of this package without it, all attributes. Dictionaries,
lists and queues are kept by their items, objects of this package by their own attributes, and everything else, arrays
included, by identity: arrays of state are replaced, and never written.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import importlib
import sys
import threading
from collections import deque
from collections.abc import Callable, Collection, Hashable, Mapping
from types import FrameType
from typing import Any, ClassVar, Concatenate, NamedTuple, ParamSpec, TypeVar

import numpy as np

_PACKAGE = "gpusense.localization."
_PLAIN = (bool, int, float, str, np.generic)
# Containers whose items are state, each with the function that replaces all of them.
_REPLACE: dict[type, Callable[[Any, Any], None]] = {
    dict: lambda target, items: (target.clear(), target.update(items)) and None,
    list: lambda target, items: target.__setitem__(slice(None), items),
    deque: lambda target, items: (target.clear(), target.extend(items)) and None,
}

P = ParamSpec("P")
R = TypeVar("R")


@functools.cache
def _is_followed(kind: Hashable) -> bool:
    """Return whether the attributes of a class's objects are state."""
    if not isinstance(kind, type):
        return False
    if hasattr(kind, "MEMORY"):
        return True
    own = kind.__module__.startswith(_PACKAGE) and not issubclass(kind, (tuple, type))
    return own and not getattr(kind, "__dataclass_params__", None)


def _attributes(owner: Any) -> dict[str, Any]:
    """Return the state of an object by name; attributes that are not set yet are left out."""
    values, names = vars(owner), getattr(owner, "MEMORY", None)
    return values.copy() if names is None else {name: values[name] for name in names if name in values}


class Journal:
    """All of an object's state at one moment.

    Args:
        owner: The object.
        frame: The call that may change it.
    """

    def __init__(self, owner: Any, frame: FrameType | None = None) -> None:
        self._frame = frame
        self._objects: list[tuple[Any, dict[str, Any]]] = []
        self._containers: list[tuple[Any, Any]] = []
        seen: set[int] = set()
        open_ = [owner]
        while open_:
            one = open_.pop()
            if id(one) in seen:
                continue
            seen.add(id(one))
            kind = type(one)
            if _is_followed(kind):
                values = _attributes(one)
                self._objects.append((vars(one), values))
                items = values.values()
            else:
                kept = one.copy()
                self._containers.append((one, kept))
                items = kept.values() if kind is dict else kept
            open_ += [item for item in items if type(item) in _REPLACE or _is_followed(type(item))]

    def is_running(self) -> bool:
        """Return whether the call that may change the object has called the present one."""
        frame: FrameType | None = sys._getframe(1)
        while frame is not None:
            if frame is self._frame:
                return True
            frame = frame.f_back
        return False

    def restore(self) -> None:
        """Put everything back; repeated if it was interrupted."""
        for attributes, values in self._objects:
            attributes.update(values)
        for container, items in self._containers:
            _REPLACE[type(container)](container, items)


class Whole:
    """Base of objects whose calls change all of their state or none.

    Calls of several threads wait for one another.
    """

    _journal: Journal | None = None

    def _begin_journals(self) -> None:
        """Prepare the object for calls that are :func:`whole`."""
        self._calls = threading.RLock()

    def settle(self) -> None:
        """Put the state back that an interrupted call has left behind."""
        if self._journal is not None and not self._journal.is_running():
            self._journal.restore()
            self._journal = None


W = TypeVar("W", bound=Whole)


def whole(method: Callable[Concatenate[W, P], R]) -> Callable[Concatenate[W, P], R]:
    """Make a method change all of its object's state, or, where it raises, none."""

    @functools.wraps(method)
    def call(self: W, /, *args: P.args, **kwargs: P.kwargs) -> R:
        with self._calls:
            self.settle()
            if self._journal is not None:
                # Part of a call that is whole.
                return method(self, *args, **kwargs)
            journal = self._journal = Journal(self, sys._getframe())
            try:
                result = method(self, *args, **kwargs)
                self._journal = None
                return result
            except BaseException:
                journal.restore()
                self._journal = None
                raise

    return call


# ---- plain data


class Held(NamedTuple):
    """State of an object of this package as plain data.

    Attributes:
        kind: Module and name of its class.
        values: Its attributes by name.
    """

    kind: tuple[str, str]
    values: dict[str, Any]


class _NotPlainError(Exception):
    """A value that is no state: of a device, or of another package."""


def plain_state(owner: Any, *, without: Collection[str] = ()) -> dict[str, Any]:
    """Return the state of an object as plain data, which pickles and holds no device.

    Args:
        owner: The object.
        without: Names of attributes that are left out.
    """
    found = {}
    for name, value in _attributes(owner).items():
        if name not in without:
            with contextlib.suppress(_NotPlainError):
                found[name] = _plain(value)
    return found


def _plain(value: Any) -> Any:
    """Return a copy of a value as plain data.

    Raises:
        _NotPlainError: it is none.
    """
    kind = type(value)
    if isinstance(value, np.ndarray):
        return value.copy()
    if value is None or isinstance(value, _PLAIN):
        return value
    if kind is dict:
        return {key: _plain(item) for key, item in value.items()}
    if kind is deque:
        return deque(map(_plain, value), value.maxlen)
    if kind is list:
        return [_plain(item) for item in value]
    if isinstance(value, tuple):
        items = [_plain(item) for item in value]
        return tuple(items) if kind is tuple else kind(*items)
    if _is_followed(kind):
        return Held((kind.__module__, kind.__qualname__), plain_state(value))
    raise _NotPlainError


def set_state(owner: Any, values: Mapping[str, Any]) -> None:
    """Set the state of an object to that of ``plain_state``."""
    for name, value in values.items():
        setattr(owner, name, _merged(vars(owner).get(name), value))


def _merged(now: Any, value: Any) -> Any:
    """Return a value of plain data; objects of this package, and what they know beside their state, are those now."""
    if isinstance(value, Held):
        kind = type(now)
        target = now
        if (kind.__module__, kind.__qualname__) != value.kind:
            module, name = value.kind
            if not module.startswith(_PACKAGE):
                raise ValueError(f"state: must hold objects of gpusense, got one of {module}")
            made = getattr(importlib.import_module(module), name)
            target = made.__new__(made)
        set_state(target, value.values)
        return target
    if isinstance(value, dict):
        return {key: _merged(now.get(key) if isinstance(now, dict) else None, item) for key, item in value.items()}
    if isinstance(value, list):
        old = now if isinstance(now, list) and len(now) == len(value) else [None] * len(value)
        return [_merged(*pair) for pair in zip(old, value, strict=True)]
    return copy.copy(value) if isinstance(value, (np.ndarray, deque)) else value
