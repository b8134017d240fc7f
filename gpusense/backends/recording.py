"""Recordings: programs with bound arguments, for repeated starts."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any


class Recording(ABC):
    """A program whose arguments are bound: it is started repeatedly with the same memory and numbers."""

    @abstractmethod
    def __call__(self, stream: Any = None) -> None:
        """Start it on a stream of the device, or on its current one."""

    @abstractmethod
    def wait(self, *, elsewhere: bool = False) -> None:
        """Wait until all starts have ended.

        ``elsewhere``: wait only for starts on streams other than the device's current one; copies on that one follow
        its launches without a wait.
        """

    @abstractmethod
    def explain(self) -> str:
        """Return in one line how it is started: as one graph, or launch by launch with the reason."""


def pluralize(number: int, noun: str) -> str:
    """Return a number of launches or copies in words: ``"3 launches"``."""
    if number == 1:
        return f"1 {noun}"
    return f"{number} {noun[:-1]}ies" if noun.endswith("y") else f"{number} {noun}es"
