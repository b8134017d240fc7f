"""Sort short lists of numbers."""

from __future__ import annotations

import numpy as np


def sort_numbers(number: np.ndarray) -> None:
    """Sort the rows of an array in ascending order, in place."""
    number.sort(axis=1)
