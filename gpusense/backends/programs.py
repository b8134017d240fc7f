"""Programs that run repeatedly: recorded by their keys."""

from __future__ import annotations

from collections.abc import Callable, Hashable

from gpusense.backends.base import Backend
from gpusense.backends.recording import Recording
from gpusense.interface.launches import Program


class ProgramCache:
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
