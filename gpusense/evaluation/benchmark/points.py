"""Read the method, an error and a time of a report's point."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def label(point: Mapping[str, Any]) -> str:
    """Name a point's method with its variant."""
    return f"{point['method']}, {point['variant']}" if point["variant"] else str(point["method"])


def setting(point: Mapping[str, Any]) -> str:
    """Format a point's knob with its value; empty without a knob."""
    return f"{point['knob']} = {point['value']:g}" if point["knob"] else ""


def error_of(point: Mapping[str, Any], kind: str, name: str) -> float | None:
    """Return an error of a point; None where the point failed or lacks that kind."""
    value = ((point.get("errors") or {}).get(kind) or {}).get(name)
    return None if value is None or point["status"] != "ok" else float(value)


def time_of(point: Mapping[str, Any], timing: str) -> float | None:
    """Return the least time of a point's calls or launches [s]; None where it was not measured."""
    value = (point.get("time") or {}).get(f"{timing}_min_s")
    return float(value) if value else None
