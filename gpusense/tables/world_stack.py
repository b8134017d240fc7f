"""Worlds of one size whose tables are made together, and such tables."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from gpusense.backends.base import Buffer
from gpusense.backends.workspace import Workspace


class Stack(NamedTuple):
    """Some worlds of one size whose tables are made together.

    Attributes:
        indices: (W,) indices of the worlds.
        rows: Rows of each.
        cols: Columns of each.
        place: First cell of each in tables with a ring, on the device.
        space: Memory besides the tables.
    """

    indices: np.ndarray
    rows: int
    cols: int
    place: Buffer
    space: Workspace

    @property
    def worlds(self) -> int:
        """W."""
        return len(self.indices)


class Table(NamedTuple):
    """A table of all worlds.

    Attributes:
        buffer: The table.
        size: Its size [bytes].
        fill: Function that fills the parts of a stack of worlds.
    """

    buffer: Buffer
    size: int
    fill: Callable[[Stack, Buffer], None]
