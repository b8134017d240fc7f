"""Wrap angles."""

from __future__ import annotations

import math
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray


@overload
def wrapped(angle: float) -> float: ...


@overload
def wrapped(angle: NDArray[np.floating]) -> NDArray[np.float64]: ...


def wrapped(angle: Any) -> Any:
    """Return angles in [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi
