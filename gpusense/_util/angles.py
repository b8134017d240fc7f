"""Wrap angles."""

from __future__ import annotations

import math
from typing import Any


def wrapped(angle: Any) -> Any:
    """Return angles in [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi
