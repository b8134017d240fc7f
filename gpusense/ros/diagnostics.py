"""Make the fields of diagnostic_msgs/DiagnosticStatus, without ROS."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

OK, WARN, ERROR, STALE = 0, 1, 2, 3
LEVELS = {"tracking": OK, "uncertain": WARN, "lost": ERROR}


def radius_text(radius: float) -> str:
    """Return a radius of protection with millimetres [m]; ``inf`` if none is promised."""
    return f"{radius:.3f}"


def status_fields(
    name: str, level: int, message: str, values: Mapping[str, str], node: str = "gpusense"
) -> dict[str, Any]:
    """Return the fields of diagnostic_msgs/DiagnosticStatus; ``node`` distinguishes robots."""
    pairs = [{"key": key, "value": value} for key, value in values.items()]
    return {"name": f"{node}: {name}", "hardware_id": node, "level": level, "message": message, "values": pairs}
