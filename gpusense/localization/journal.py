"""Change a filter's state on the host atomically, and copy it to and from plain data.

Python may raise KeyboardInterrupt between any two lines. A call that changes a filter first saves all attributes in a
journal, and at its end drops the journal by one assignment. After an interrupt the journal restores the attributes at
once or, if a second interrupt prevents that, before the next call. Buffers on a device need no copy, since a step
writes only buffers that no attribute names yet.

A class lists its state in ``MEMORY``, and attributes with further state in ``PARTS``. In any other class of this
package all attributes are state. Dictionaries, lists and queues are saved item by item, objects of this package
attribute by attribute, everything else by identity. The last group includes arrays: arrays of state are replaced, never
written.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import importlib
import sys
import threading
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping
from types import FrameType
from typing import Any, Concatenate, NamedTuple, ParamSpec, TypeVar

import numpy as np

_PACKAGE = "gpusense.localization."
_PLAIN = (bool, int, float, str, np.generic)
# Sensors are state of the filter only, although other parts refer to them.
_SENSORS = "_sensors"
# Containers of state.
_CONTAINERS = (dict, list, deque)

P = ParamSpec("P")
R = TypeVar("R")


# Kinds of values, by their class.
_OTHER, _OBJECT, _CONTAINER = range(3)


class _Kinds(dict[type, int]):
    """Map classes to the kind of their state: attributes, items or identity."""

    def __missing__(self, kind: type) -> int:
        own = kind.__module__.startswith(_PACKAGE) and not issubclass(kind, (tuple, type))
        own = own and not hasattr(kind, "__dataclass_params__")
        found = self[kind] = (
            _CONTAINER if kind in _CONTAINERS else _OBJECT if own or hasattr(kind, "MEMORY") else _OTHER
        )
        return found


_KINDS = _Kinds()


def _attributes(owner: Any) -> dict[str, Any]:
    """Return the state of an object by name, without unset attributes."""
    values: dict[str, Any] = owner.__dict__
    names: Collection[str] = getattr(owner, "MEMORY", ())
    return {name: values[name] for name in names if name in values} if names else values.copy()


class Journal:
    """The complete state of objects at one moment, and the call that may change them."""

    __slots__ = ("_containers", "_frame", "_objects")

    def __init__(self, owners: Iterable[Any], frame: FrameType | None = None) -> None:
        self._frame = frame
        self._objects: list[tuple[Any, dict[str, Any]]] = []
        self._containers: list[tuple[Any, Any]] = []
        kinds, open_ = _KINDS, list(owners)
        # By identity: save each object or container once.
        seen: set[int] = set()
        for one in open_:
            if id(one) in seen:
                continue
            seen.add(id(one))
            kind = type(one)
            if kinds[kind] == _CONTAINER:
                items = one.copy()
                self._containers.append((one, items))
                for item in items.values() if kind is dict else items:
                    if kinds[type(item)]:
                        open_.append(item)
                continue
            # Faster than choosing attributes, which ``restore`` does.
            kept = one.__dict__.copy()
            self._objects.append((one, kept))
            parts = getattr(kind, "PARTS", None)
            # Loops, as a comprehension is a call in Python 3.11.
            for name in kept if parts is None else parts:
                item = kept[name]
                if kinds[type(item)] and (parts is not None or name != _SENSORS):
                    open_.append(item)

    def is_running(self) -> bool:
        """Return whether the present call is within the journal's call."""
        frame: FrameType | None = sys._getframe(1)
        while frame is not None:
            if frame is self._frame:
                return True
            frame = frame.f_back
        return False

    def close(self) -> None:
        """Drop the reference to the call's frame, which refers back to this object."""
        self._frame = None

    def restore(self) -> None:
        """Restore everything; an interrupted restoration is repeated."""
        for one, values in self._objects:
            names = getattr(one, "MEMORY", values)
            one.__dict__.update({name: values[name] for name in names if name in values})
        for container, items in self._containers:
            container.clear()
            (container.update if type(container) is dict else container.extend)(items)


class Transactional:
    """Base class of objects with atomic calls, serialised over threads."""

    _journal: Journal | None = None

    def _begin_journals(self) -> None:
        """Prepare the object for :func:`atomic` calls."""
        self._calls = threading.RLock()

    def _keep(self) -> None:
        """Record the buffers that the present call must not overwrite."""

    def _changing(self) -> tuple[Any, ...]:
        """Return all objects that a call may change: this one and its parts."""
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
            self.settle()
            if self._journal is not None:
                # A call within an atomic call.
                return method(self, *args, **kwargs)
            self._keep()
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
                journal.close()

    return call


def consistent(method: Callable[Concatenate[W, P], R]) -> Callable[Concatenate[W, P], R]:
    """Settle the state before a method that changes state only through :func:`atomic` methods."""

    @functools.wraps(method)
    def call(self: W, /, *args: P.args, **kwargs: P.kwargs) -> R:
        with self._calls:
            self.settle()
            return method(self, *args, **kwargs)

    return call


# ---- plain data


class Held(NamedTuple):
    """State of an object of this package as plain data: module and name of its class, and its attributes by name."""

    kind: tuple[str, str]
    values: dict[str, Any]


class _NotPlainError(Exception):
    """A value is no plain data, such as an object of a device or another package."""


def plain_state(owner: Any, *, without: Collection[str] = ()) -> dict[str, Any]:
    """Return the state of an object, without some attributes, as plain data that pickles and holds no device."""
    found = {}
    for name, value in _attributes(owner).items():
        if name not in without:
            with contextlib.suppress(_NotPlainError):
                found[name] = _plain(value)
    return found


def _plain(value: Any) -> Any:
    """Return a copy of a value as plain data."""
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
    if _KINDS[kind] == _OBJECT:
        return Held((kind.__module__, kind.__qualname__), plain_state(value))
    raise _NotPlainError


def set_state(owner: Any, values: Mapping[str, Any]) -> None:
    """Set the state of an object from the result of ``plain_state``."""
    for name, value in values.items():
        setattr(owner, name, _merged(vars(owner).get(name), value))


def _merged(now: Any, value: Any) -> Any:
    """Return a value from plain data; present objects of this package keep all other attributes."""
    if isinstance(value, Held):
        kind = type(now)
        target = now
        if (kind.__module__, kind.__qualname__) != value.kind:
            module, name = value.kind
            if not module.startswith(_PACKAGE):
                raise ValueError(f"state: must hold objects of gpusense, got one of {module}")
            made = getattr(importlib.import_module(module), name)
            target = made.__new__(made)
        elif not hasattr(kind, "MEMORY"):
            # A new object, for a single assignment.
            target = copy.copy(now)
        set_state(target, value.values)
        return target
    if isinstance(value, dict):
        return {key: _merged(now.get(key) if isinstance(now, dict) else None, item) for key, item in value.items()}
    if isinstance(value, list):
        old = now if isinstance(now, list) and len(now) == len(value) else [None] * len(value)
        return [_merged(*pair) for pair in zip(old, value, strict=True)]
    return copy.copy(value) if isinstance(value, (np.ndarray, deque)) else value
