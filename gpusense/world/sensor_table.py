"""Interface of sensor tables: log p over readings and expected ranges, in bins of one width."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from numpy.typing import DTypeLike, NDArray


class SensorTable(ABC):
    """A table of a sensor for ``BeamModel``: one look-up per beam, max readings included."""

    range_max: float
    """Readings of at least ``range_max`` are "no return", > 0 [m]."""
    bins: int
    """Number of range bins; one more bin is for "no return"."""

    @abstractmethod
    def sensor_table(self, dtype: DTypeLike) -> NDArray[Any]:
        """Return the (bins + 1, bins + 1) table of log densities by bin of the reading, then of the expected range.

        The last row, "no return", holds log probabilities.
        """

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """Return the table's parameters as plain numbers and strings."""
