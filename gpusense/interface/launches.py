"""Launches: a kernel, its flags, its size, and its arguments by name.

A program is a tuple of launches. It is plain data that tests can read and backends can run or record.
"""

from __future__ import annotations

from collections.abc import Container, Iterable
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np

from gpusense.interface.signatures import KERNELS, Kernel
from gpusense.interface.structs import STRUCTS

_INTEGERS = (int, np.integer)
_NUMBERS = (int, float, np.integer, np.floating)


class Launch(NamedTuple):
    """A launch of a kernel."""

    kernel: str  # its name in the signature table
    flags: frozenset[str]  # flags of its code
    size: tuple[int, ...]  # number of work-items along each axis of the row's launch shape
    # Buffers, scalars and structs in the order of the row; only those that the code of the flags takes.
    arguments: tuple[Any, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the arguments."""
        return _row(self.kernel, self.flags).names

    def places(self, names: Container[str]) -> list[tuple[int, str]]:
        """Return the positions and names of the kernel's arguments that are in a set of names."""
        return [(place, name) for place, name in enumerate(self.names) if name in names]

    def without(self, names: Container[str]) -> Launch:
        """Return the launch with None in place of the arguments of a set of names."""
        pairs = zip(self.names, self.arguments, strict=True)
        return self._replace(arguments=tuple([None if name in names else value for name, value in pairs]))

    def named(self) -> dict[str, Any]:
        """Return the arguments by name."""
        return dict(zip(self.names, self.arguments, strict=True))


Program = tuple[Launch, ...]


def launch(kernel: str, flags: Iterable[str], size: tuple[int, ...], /, **arguments: Any) -> Launch:
    """Bind the arguments of a kernel by name; those that the code of the flags does not take are dropped."""
    flags = frozenset(flags)
    row = _row(kernel, flags)
    try:
        values = row.take(arguments)
    except KeyError:
        raise TypeError(_difference(kernel, row, arguments)) from None
    if not arguments.keys() <= row.known:
        raise TypeError(_difference(kernel, row, arguments))
    types = tuple(map(type, values))
    if types not in row.accepted:
        row.check(types)
    return Launch(kernel, flags, size, values)


def flags_of(program: Program) -> frozenset[str]:
    """Return the flags of all launches of a program."""
    return frozenset[str]().union(*(one.flags for one in program))


class _Row:
    """A row of the signature table that binds arguments."""

    def __init__(self, kernel: str, row: Kernel) -> None:
        self._kernel, self._row = kernel, row
        self.names = tuple(argument.name for argument in row.arguments)
        self.known = frozenset(argument.name for argument in KERNELS[kernel].arguments)
        self.take = itemgetter(*self.names)
        # Types that have passed the check, as calls repeat them.
        self.accepted: set[tuple[type, ...]] = set()

    def check(self, types: tuple[type, ...]) -> None:
        """Check the types of arguments against the row."""
        for argument, kind in zip(self._row.arguments, types, strict=True):
            is_number = issubclass(kind, _NUMBERS)
            if argument.shape is not None:
                rule, holds = "a buffer", not is_number and not issubclass(kind, tuple)
            elif argument.is_struct:
                rule, holds = f"a {argument.type}", issubclass(kind, STRUCTS[argument.type])
            elif argument.type == "int":
                rule, holds = "an integer", issubclass(kind, _INTEGERS)
            else:
                rule, holds = "a number", is_number
            if not holds:
                raise TypeError(f"{self._kernel}: {argument.name} must be {rule}, got a {kind.__name__}")
        self.accepted.add(types)


_ROWS: dict[tuple[str, frozenset[str]], _Row] = {}


def _row(kernel: str, flags: frozenset[str]) -> _Row:
    """Return the row of a kernel's code."""
    whole = KERNELS[kernel]
    key = kernel, flags & whole.optional
    return _ROWS.get(key) or _ROWS.setdefault(key, _Row(kernel, whole.with_flags(flags)))


def _difference(kernel: str, row: _Row, arguments: dict[str, Any]) -> str:
    """Return the message on missing and unknown arguments."""
    missing = [name for name in row.names if name not in arguments]
    unknown = [name for name in arguments if name not in row.known]
    parts = [f"missing {', '.join(missing)}" if missing else "", f"unknown {', '.join(unknown)}" if unknown else ""]
    return f"{kernel}: arguments must be those of its signature, got {' and '.join(part for part in parts if part)}"
