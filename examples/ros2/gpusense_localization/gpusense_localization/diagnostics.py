"""Fields of diagnostic_msgs/DiagnosticStatus, without ROS."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

OK, WARN, ERROR, STALE = 0, 1, 2, 3
LEVELS = {"tracking": OK, "uncertain": WARN, "lost": ERROR}


def status_fields(name: str, level: int, message: str, values: Mapping[str, str]) -> dict[str, Any]:
    """Return the fields of diagnostic_msgs/DiagnosticStatus.

    Args:
        name: Subject of the status, after "gpusense: ".
        level: OK, WARN, ERROR or STALE.
        message: One line for people.
        values: Values by their names.
    """
    pairs = [{"key": key, "value": value} for key, value in values.items()]
    return {"name": f"gpusense: {name}", "hardware_id": "", "level": level, "message": message, "values": pairs}
