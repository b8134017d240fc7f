"""The table of a sensor: log p over readings and expected ranges, in bins of one width."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from numpy.typing import DTypeLike, NDArray


class SensorTable(ABC):
    """A table of a sensor, for ``BeamModel``: one look-up a beam, max readings too."""

    range_max: float
    """Readings of at least this are "no return", > 0 [m]."""
    bins: int
    """Bins of a range; one more is for no return."""

    @abstractmethod
    def sensor_table(self, dtype: DTypeLike) -> NDArray[Any]:
        """Return the (bins + 1, bins + 1) table by reading, then by expected range: log densities or probabilities.

        Raises:
            ValueError: some logarithm does not fit the dtype.
        """

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """Return the table's parameters as plain numbers and strings."""
