"""Base class of results of fits: conversion to dictionaries, and tables."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from gpusense._util.html import FIT_HEAD, card

P = TypeVar("P")


class FitRow(NamedTuple):
    """A parameter in the table of a fit: name, value, standard error, and a note."""

    name: str
    value: Any
    error: float
    note: str


@dataclass(frozen=True, eq=False)
class Fitted(Generic[P]):
    """Result of a fit; subclasses describe the attributes."""

    parameters: P
    log_likelihood: float
    trace: NDArray[np.float64]
    converged: bool
    status: str
    standard_errors: dict[str, float]
    held: dict[str, str]
    iterations: int
    missing: int

    def to_dict(self) -> dict[str, Any]:
        """Return all attributes except arrays of readings as plain numbers, lists and strings; None if not finite."""
        return {field.name: _plain(getattr(self, field.name)) for field in fields(self) if field.repr}

    def _rows(self) -> list[FitRow]:
        """List the rows of the table."""
        return [
            FitRow(name, value, error, self.held.get(name, ""))
            for name, error in self.standard_errors.items()
            if (value := self._value(name)) is not None
        ]

    def _value(self, name: str) -> Any:
        """Return a parameter; None without readings of it."""
        return getattr(self.parameters, name)

    def _repr_html_(self) -> str:
        rows = [(row.name, row.value, _error(row.error), row.note) for row in self._rows()]
        return card(f"{type(self).__name__}: {self.status}", rows, head=FIT_HEAD, detail=str(self))

    def _table(self, units: dict[str, str], independent: dict[str, float]) -> list[str]:
        """Return the lines of the table, including a column of errors for independent readings, if any."""
        lines = [
            f"{'parameter':16}{'value':>13}{'std. error':>13}{'if independent' if independent else '':>16}".rstrip()
        ]
        for name, value, error, note in self._rows():
            number = f"{value:13.6g}" if math.isfinite(value) else f"{'-':>13}"
            second = f"{_error(independent[name]):>16}" if independent else ""
            lines.append(f"{name:16}{number}{_error(error):>13}{second} {units.get(name, ''):4}  {note}".rstrip())
        return lines


def _plain(value: Any) -> Any:
    """Return parameters, arrays and mappings as dictionaries and lists of plain values."""
    if hasattr(value, "to_dict"):
        return value.to_dict()
    if isinstance(value, np.ndarray):
        return [_plain(number) for number in value.tolist()]
    if isinstance(value, dict):
        return {name: _plain(number) for name, number in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _error(error: float) -> str:
    return f"{error:.3g}" if math.isfinite(error) else "inf" if error == math.inf else "-"
