"""Worlds of one size whose tables are made together, and such tables."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from gpusense.backends.base import Buffer
from gpusense.backends.workspace import Workspace


class Stack(NamedTuple):
    """Some worlds of one size whose tables are made together."""

    indices: np.ndarray  # (W,) indices of the worlds
    rows: int  # rows of each
    cols: int  # columns of each
    place: Buffer  # first cell of each in tables with a ring, on the device
    space: Workspace  # memory besides the tables

    @property
    def worlds(self) -> int:
        """W."""
        return len(self.indices)


class Table(NamedTuple):
    """A table of all worlds."""

    buffer: Buffer  # the table
    size: int  # its size [bytes]
    fill: Callable[[Stack, Buffer], None]  # function that fills the parts of a stack of worlds
