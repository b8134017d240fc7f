"""Define the interface of casters: input, table and base class."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from gpusense.backends import Backend
from gpusense.backends.base import Buffer
from gpusense.interface import structs
from gpusense.interface.casters import ENTRIES, CasterEntry
from gpusense.world.windows import Window


@dataclass(frozen=True)
class CasterInput:
    """Window of a map, the input of a caster's table."""

    obstacles: np.ndarray  # (rows, cols) bool
    limit: float  # longest range [cells]
    outside: str  # ``"free"`` or ``"occupied"``: state of space outside the grid


@dataclass(frozen=True)
class Table:
    """Table of a caster on a device."""

    buffer: Buffer  # the table
    size: int  # its size [bytes]
    flags: frozenset[str] = frozenset()  # flags of the kernels that read it


class Caster(ABC):
    """Method of computing expected ranges.

    Attributes:
        name: Name of the caster in the registry; it selects default knobs.
        exact: True for exact ranges.
        error: ``"exact"``, or the bound on its error.
        memory: Memory on the device, in words.
        precomputation: Work on the map before the first ray, in words.
        knobs: Parameters that trade error for time, in words.
        whole: True if the table needs the whole map at once.
        ring: True if a ring of cells in the table represents space outside the grid.
        stops: True if a ray may end before the longest range.
    """

    name: ClassVar[str]
    exact: ClassVar[bool] = False
    error: ClassVar[str]
    memory: ClassVar[str]
    precomputation: ClassVar[str]
    knobs: ClassVar[str] = "none"
    whole: ClassVar[bool] = False
    ring: ClassVar[bool] = True
    stops: ClassVar[bool] = True

    @property
    def beyond(self) -> int:
        """Number of cells beyond the longest range that affect a result."""
        return 0

    @property
    def entry(self) -> CasterEntry:
        """The caster in the registry."""
        return ENTRIES[self.name]

    @abstractmethod
    def prepare(self, backend: Backend, inputs: CasterInput) -> Table:
        """Make the table of a window on a device."""

    def refresh(self, backend: Backend, inputs: CasterInput, table: Buffer, changed: Window) -> bool:
        """Update ``table`` in place after obstacles changed.

        Args:
            backend: The device.
            inputs: The window after the change.
            table: Its table before the change.
            changed: Part of the window with all changed obstacles.

        Returns:
            False if the caster must make its table again.
        """
        return False

    def struct(self) -> structs.Caster:
        """Return the knobs for kernels."""
        return structs.Caster(0, 0.0, 0.0)
