"""Write the report of a run as one JSON document and as Markdown."""

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

from gpusense.evaluation.benchmark.choice import error_of, label, setting
from gpusense.evaluation.benchmark.runner import Outcome, Plan

SCHEMA = 2
"""Version of the report's fields."""

_DIGITS = 6

_READING = """\
A row is a method with a value of its knob on a device, in a scene with a cloud; report.json has all figures. Times are
nanoseconds per particle-beam: *call* is the shortest call with NumPy arrays in and out (a star marks a single call),
*processor* its processor time over all threads. *build* builds the map's tables.

Errors are against the exact caster and the models in float64: rays wrong by more than a cell, root mean square of log p
in nats, and for the posterior at a comparable temperature the Kullback-Leibler divergence in nats and the shift of its
mean. *fewer beams* counts each of every n-th beam n times; *compat* computes another program's model."""
_COLUMNS = (
    "problem", "scene", "cloud", "backend", "method", "knob", "precision", "remark", "call ns", "processor ns",
    "build s", "table MB", "> 1 cell", "log p rms", "KL", "shift m",
)  # fmt: skip
_WORDS = _COLUMNS.index("call ns")


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


def markdown(report: Mapping[str, Any]) -> str:
    """Format a report of :func:`document` as Markdown, with a row for each point."""
    machine, truth = report["machine"], report["truth"]
    facts = ", ".join(f"{name} {value}" for name, value in machine.items())
    lines = [
        "# Error against run time", "", f"{report['date']}, commit {report['commit'] or 'unknown'}. {facts}.", "",
        *(f"- {d['selection']}: {d['name']} ({d['driver']})" for d in report["devices"]),
        *(f"- absent: {text}" for text in report["absent"]), "",
        f"Truth: {truth['backend']} ({truth['device']}), {truth['precision']}: {truth['note']}.",
        f"Arguments: {', '.join(f'{key} {value}' for key, value in report['arguments'].items())}.", "", _READING, "",
        *table(_COLUMNS, [_row(point) for point in report["points"]], _WORDS),
    ]  # fmt: skip
    return "\n".join(lines)


def table(columns: Sequence[str], rows: Iterable[Sequence[str]], numbers: int) -> list[str]:
    """Format the lines of a Markdown table; columns from ``numbers`` on are right-aligned."""
    rule = [" --- " if i < numbers else " ---: " for i in range(len(columns))]
    cells = [columns, *([text.replace("|", "\\|") for text in row] for row in rows)]
    lines = [f"| {' | '.join(row)} |" for row in cells]
    return [lines[0], f"|{'|'.join(rule)}|", *lines[1:]]


def _row(point: Mapping[str, Any]) -> list[str]:
    """Format a point's cells of ``_COLUMNS``."""
    time_s, memory = (point[name] or {} for name in ("time", "memory"))
    backend = f"{point['backend']}: {point['device']}" if point["outside"] else point["backend"]
    name = f"**{label(point)}**" if point["exact"] else label(point)
    remark = "" if point["status"] == "ok" else f"{point['status']}: {point['reason']}"
    wrong = error_of(point, "ranges", "wrong_1")
    errors = (("log_p", "rms"), ("comparable", "kl"), ("comparable", "shift_m"))
    return [
        *(str(point[key]) for key in ("problem", "scene", "cloud")), backend, name, setting(point), point["precision"],
        remark, _per_beam(point, "call_min_s") + ("*" if time_s.get("calls") == 1 else ""),
        _per_beam(point, "processor_s"), _text(time_s.get("build_s")),
        _text(memory.get("table_bytes"), 1e-6), "-" if wrong is None else f"{100 * wrong:.2g} %",
        *(_text(error_of(point, *place)) for place in errors),
    ]  # fmt: skip


def _per_beam(point: Mapping[str, Any], name: str) -> str:
    seconds = (point["time"] or {}).get(name)
    return _text(None if seconds is None else seconds / max(point["work"], 1), 1e9)


def _text(value: float | None, scale: float = 1.0) -> str:
    return "-" if value is None else f"{value * scale:.3g}"
