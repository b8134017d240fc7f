"""Recordings: programs with bound arguments, which are started repeatedly."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable
from typing import TYPE_CHECKING, Any

from gpusense.interface.launches import Program

if TYPE_CHECKING:
    from gpusense.backends.base import Backend


class Recording(ABC):
    """A program whose arguments are bound: it is started repeatedly with the same memory and numbers."""

    @abstractmethod
    def __call__(self, stream: Any = None) -> None:
        """Start it on a stream of the device, or on its current one."""

    @abstractmethod
    def wait(self) -> None:
        """Wait until all starts have ended."""

    @abstractmethod
    def explain(self) -> str:
        """Return in one line how it is started: as one graph, or one by one, with the reason."""


class Repeated:
    """Runs programs by keys, and records one that runs a second time.

    Args:
        backend: The device.
        most: Most programs that are kept.
    """

    def __init__(self, backend: Backend, most: int) -> None:
        self._backend, self._most = backend, most
        self._kept: dict[Hashable, Recording | None] = {}

    def run(self, key: Hashable, make: Callable[[], Program]) -> None:
        """Run the program of a key, which determines it."""
        if recording := self._kept.get(key):
            recording()
            return
        program = make()
        self._backend.run(program)
        kept = self._backend.record(program) if key in self._kept else None
        self._kept = dict([*self._kept.items()][1 - self._most :]) | {key: kept}

    def clear(self) -> None:
        """Forget all programs."""
        self._kept.clear()


def counted(number: int, noun: str) -> str:
    """Return a number of launches or copies in words: ``"3 launches"``."""
    if number == 1:
        return f"1 {noun}"
    return f"{number} {noun[:-1]}ies" if noun.endswith("y") else f"{number} {noun}es"
