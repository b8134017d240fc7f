"""Write the report of a run as one JSON document, and tables as Markdown."""

from __future__ import annotations

import contextlib
import json
import math
import subprocess
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from gpusense.evaluation.benchmark.runner import Outcome, Plan

SCHEMA = 2
"""Version of the report's fields."""

_DIGITS = 6


def document(
    plan: Plan,
    outcome: Outcome,
    arguments: Mapping[str, Any],
    machine: Mapping[str, Any],
    absent: Sequence[str],
    command: str = "",
) -> dict[str, Any]:
    """Build the report from plain values; non-finite numbers become None."""
    value = {
        "schema": SCHEMA,
        "date": time.strftime("%Y-%m-%d"),
        "commit": commit(),
        "command": command,
        "arguments": dict(arguments),
        "machine": dict(machine),
        "devices": [asdict(backend.info) for backend in plan.backends],
        "absent": list(absent),
        "truth": outcome.truth,
        "scenes": outcome.scenes,
        "points": outcome.points,
    }
    return {key: plain(item) for key, item in value.items()}


def plain(value: Any) -> Any:
    """Convert a value to JSON's types; round numbers to six digits and replace non-finite ones by None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None
    return value


def to_json(report: Mapping[str, Any]) -> str:
    """Format a report as JSON with one line per list element, so that two reports can be diffed."""
    parts = []
    for key, value in report.items():
        if isinstance(value, list) and value:
            lines = ",\n".join(f"  {json.dumps(item, allow_nan=False)}" for item in value)
            parts.append(f"{json.dumps(key)}: [\n{lines}\n ]")
        else:
            parts.append(f"{json.dumps(key)}: {json.dumps(value, allow_nan=False)}")
    return "{\n " + ",\n ".join(parts) + "\n}\n"


def commit() -> str | None:
    """Return the commit of the package's checkout, with a plus if files differ; None outside a checkout."""
    root = Path(__file__).resolve().parents[3]
    if not ((root / "pyproject.toml").is_file() and (root / "gpusense").is_dir()):
        return None

    def git(*words: str) -> str:
        command = ["git", "-C", str(root), *words]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=20).stdout.strip()

    with contextlib.suppress(OSError, subprocess.SubprocessError):
        return git("rev-parse", "--short=12", "HEAD") + ("+" if git("status", "--porcelain", "-uno") else "")
    return None


def table(columns: Sequence[str], rows: Iterable[Sequence[str]], numbers: int) -> list[str]:
    """Format the lines of a Markdown table; columns from ``numbers`` on are right-aligned."""
    rule = [" --- " if i < numbers else " ---: " for i in range(len(columns))]
    cells = [columns, *([text.replace("|", "\\|") for text in row] for row in rows)]
    lines = [f"| {' | '.join(row)} |" for row in cells]
    return [lines[0], f"|{'|'.join(rule)}|", *lines[1:]]
