"""The programs of earlier calls, which repeated calls start again.

A cache belongs to one owner (a workspace, a bound call, the particles of a filter), holds strong references to its
programs and their buffers, and is referenced only by its owner. Nothing in it refers to the owner, so programs and
their memory are freed with the owner at once, without the garbage collector. They are freed earlier:

- the oldest one when there are too many,
- all of them when the owner clears the cache, because it replaces a buffer that they use, or the table of the map.

The owner's lock also protects the cache, since programs share the owner's buffers. A forked child must not use the
device, and its first start of a program is an error (``Backend.check_process``).
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any, Generic, TypeVar

from gpusense.backends.base import Backend, Recording
from gpusense.interface.launches import Program, flags_of

T = TypeVar("T")


class ProgramCache(Generic[T]):
    """Programs by their keys, in the form in which their owner starts them."""

    def __init__(self, most: int) -> None:
        self._most, self._kept = most, dict[Hashable, T]()
        # The program of a key, or None.
        self.get = self._kept.get

    def __len__(self) -> int:
        return len(self._kept)

    def keep(self, key: Hashable, program: T) -> T:
        """Store the program of a key, which determines it, and return it."""
        while len(self._kept) >= self._most:
            del self._kept[next(iter(self._kept))]
        self._kept[key] = program
        return program

    def items(self) -> list[tuple[Hashable, T]]:
        """Return the keys with their programs, the last one at the end."""
        return [*self._kept.items()]

    def clear(self) -> None:
        """Drop all programs."""
        self._kept.clear()


class RecordedProgram:
    """The recording of a program.

    Attributes:
        flags: Flags of its launches.
        recording: The recording.
    """

    def __init__(self, backend: Backend, program: Program, owners: object = None) -> None:
        self.flags, self.recording = flags_of(program), backend.record(program)
        self._backend, self._owners = backend, owners

    def __call__(self, changing: dict[str, Any]) -> None:
        """Start it as part of a call; its key holds the arguments of the call."""
        self._backend.check_process()
        self._backend.replay(self.recording)

    def start(self) -> None:
        """Start it now."""
        self._backend.check_process()
        self.recording()


class RepeatedPrograms:
    """Programs that may run again: each is recorded when it runs a second time."""

    def __init__(self, backend: Backend, most: int) -> None:
        self._backend, self._programs = backend, ProgramCache[Recording](most)
        # Keys of programs that have run once.
        self._seen = ProgramCache[bool](most)

    def run(self, key: Hashable, make: Callable[[], Program]) -> None:
        """Run the program of a key, which determines it."""
        recording = self._programs.get(key)
        if recording is not None:
            self._backend.check_process()
            recording()
            return
        program = make()
        self._backend.run(program)
        if self._seen.get(key):
            self._programs.keep(key, self._backend.record(program))
        else:
            self._seen.keep(key, True)

    @property
    def last(self) -> Recording:
        """The recording that was made last; there must be one."""
        return self._programs.items()[-1][1]

    def clear(self) -> None:
        """Drop all programs."""
        self._programs.clear()
        self._seen.clear()
