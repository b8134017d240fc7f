"""Steps of a call on a Warp device: launches, copies and recordings, which can wait to be started."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Hashable, Sequence

import warp as wp

from gpusense.backends.base import pluralize


class Step(ABC):
    """Work that a stream does."""

    key: Hashable  # the work and its memory: steps of equal keys are the same
    launches: int = 0  # number of launches in it
    copies: int = 0  # number of copies in it
    reports: bool = False  # true if it reports how the call with it is started

    @abstractmethod
    def start(self, stream: wp.Stream | None) -> None:
        """Start it on a stream, or on the device's current one."""

    def note(self, started: str) -> None:  # noqa: B027
        """Note how the call with this step is started."""


class Copy(Step):
    """A copy of the first numbers of an array into another."""

    copies = 1

    def __init__(self, target: wp.array, source: wp.array, count: int) -> None:
        self._arguments = (target, source, count)
        self.key = (target.ptr, source.ptr, count, target.dtype)

    def start(self, stream: wp.Stream | None) -> None:
        target, source, count = self._arguments
        wp.copy(target, source, count=count, stream=stream)


def start_each(steps: Sequence[Step], stream: wp.Stream | None) -> None:
    """Start steps singly, in order."""
    for step in steps:
        step.start(stream)


def contents(steps: Sequence[Step]) -> str:
    """Return the launches and copies of steps in words: ``"3 launches and 2 copies"``."""
    launches = pluralize(sum(step.launches for step in steps), "launch")
    copies = sum(step.copies for step in steps)
    return f"{launches} and {pluralize(copies, 'copy')}" if copies else launches


def as_graph(steps: Sequence[Step]) -> str:
    """Return in words that steps are started as one graph."""
    return f"one CUDA graph of {contents(steps)}"


def one_by_one(steps: Sequence[Step], reason: str) -> str:
    """Describe that steps are started singly, and why."""
    return f"{contents(steps)} one by one: {reason}"
