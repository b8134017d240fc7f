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

from gpusense.evaluation.benchmark.choice import label, setting
from gpusense.evaluation.benchmark.runner import Outcome, Plan

SCHEMA = 2
"""Version of the report's fields."""

_DIGITS = 6

_READING = """\
Times are nanoseconds per particle-beam: a ray for *ranges*, an evaluated reading for *beam* and *field*. *call* is a
call with NumPy arrays in and out: minimum and quartiles of the calls after a warm-up. A star marks a single call, of
more than a second. *processor* is the processor's time of a call over all threads. *launch* is the minimum of the
launches alone, with all arrays on the device. *build* is the time to build the map's tables. *compile* is the
additional time of the first call in this process: kernels may come from a cache on disk, and later rows reuse compiled
kernels; where the first call takes long, *build* includes it. *table* and *device* are bytes on the device: of the
map's tables, and of all buffers that are alive after a call.

Errors are against the exact caster and the models in float64. For ranges: median, 95th percentile and maximum in cells,
and the shares wrong by more than one and two cells. For the scan's log-likelihood: root mean square and maximum in
nats; for *ranges* it follows from the ranges by the float64 mixture. For the posterior, the normalised weights: KL, the
Kullback-Leibler divergence from the exact weights in nats; TV, the total variation; and the shift of the weighted mean
pose. *tempered* is the posterior at the temperature where a tenth of the particles share the weight, as in a working
filter. *comparable* is the posterior at the temperature that gives the method's weights the same effective sample
size. *fine* compares with the true posterior, untempered, on a fine grid of poses around the true one. *fewer beams*
counts each of every n-th beam n times, and *compat* computes another model than the book's; they are shown for
comparison."""


def document(
    plan: Plan,
    outcome: Outcome,
    arguments: Mapping[str, Any],
    machine: Mapping[str, Any],
    absent: Sequence[str],
    command: str = "",
) -> dict[str, Any]:
    """Build the report from plain values; non-finite numbers become None.

    Args:
        plan: The plan.
        outcome: The measurements.
        arguments: Arguments of the command.
        machine: Description of the machine.
        absent: Devices and candidates that are absent, with reasons.
        command: The command line, files by their names.
    """
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
    """Format a report of :func:`document` as Markdown."""
    machine, truth = report["machine"], report["truth"]
    facts = ", ".join(f"{name} {value}" for name, value in machine.items())
    lines = [
        "# Error against run time", "", f"{report['date']}, commit {report['commit'] or 'unknown'}. {facts}.", "",
        *(f"- {d['selection']}: {d['name']} ({d['driver']})" for d in report["devices"]),
        *(f"- absent: {text}" for text in report["absent"]), "",
        f"Truth: {truth['backend']} ({truth['device']}), {truth['precision']}: {truth['note']}.",
        f"Arguments: {', '.join(f'{key} {value}' for key, value in report['arguments'].items())}.", "", _READING, "",
        "## Scenes", "", *_scene_table(report["scenes"]), "",
    ]  # fmt: skip
    points = report["points"]
    for status, title in (("failed", "Failed"), ("unstable", "Unstable"), ("left out", "Left out")):
        lines += _reasons(title, [point for point in points if point["status"] == status])
    groups = dict.fromkeys((p["problem"], p["scene"], p["cloud"]) for p in points)
    for problem, scene, cloud in groups:
        group = [p for p in points if (p["problem"], p["scene"], p["cloud"]) == (problem, scene, cloud)]
        lines += [f"## {problem}: {scene}, {cloud}", "", *_point_table(group, problem), ""]
    return "\n".join(lines)


def table(columns: Sequence[str], rows: Iterable[Sequence[str]], numbers: int) -> list[str]:
    """Format the lines of a Markdown table; columns from ``numbers`` on are right-aligned."""
    rule = [" --- " if i < numbers else " ---: " for i in range(len(columns))]
    cells = [columns, *([text.replace("|", "\\|") for text in row] for row in rows)]
    lines = [f"| {' | '.join(row)} |" for row in cells]
    return [lines[0], f"|{'|'.join(rule)}|", *lines[1:]]


def _scene_table(scenes: Sequence[Mapping[str, Any]]) -> list[str]:
    columns = ("scene", "map", "cells", "resolution m", "beams, hits", "cloud", "checked", "rays that hit",
               "mean range m", "effective sample size beam, field", "temperature beam, field")  # fmt: skip
    rows = [
        (
            s["name"], s["map"], f"{s['rows']} x {s['cols']}", f"{s['resolution']:g}", f"{s['beams']}, {s['hits']}",
            name, str(c["checked"]), f"{c['rays_that_hit']:.3f}", f"{c['mean_range']:.2f}",
            ", ".join(f"{c['effective_sample_size'][k]:.3g}" for k in ("beam", "field")),
            ", ".join(f"{c['temperature'][k]:.2g}" for k in ("beam", "field")),
        )
        for s in scenes for name, c in s["clouds"].items()
    ]  # fmt: skip
    return table(columns, rows, 2)


def _reasons(title: str, points: Sequence[Mapping[str, Any]]) -> list[str]:
    if not points:
        return []
    where: dict[tuple[str, ...], list[str]] = {}
    for p in points:
        key = (p["backend"], p["problem"], label(p), setting(p), p["precision"], p["reason"])
        where.setdefault(key, []).append(f"{p['scene']}, {p['cloud']}")
    columns = ("backend", "problem", "method", "knob", "precision", "why", "where")
    return [f"## {title}", "", *table(columns, [(*key, "; ".join(places)) for key, places in where.items()], 7), ""]


COLUMNS = (
    "backend", "method", "knob", "precision", "call ns", "quartiles ns", "processor ns", "launch ns", "build s",
    "compile s", "table MB", "device MB", "log p rms", "max", "KL", "shift m", "tempered KL", "comparable KL", "TV",
    "shift m", "fine KL", "shift m",
)  # fmt: skip
TIMES = 12  # columns before those of the errors
RANGE_COLUMNS = ("median", "p95", "max", "> 1 cell", "> 2 cells")


def _point_table(points: Sequence[Mapping[str, Any]], problem: str) -> list[str]:
    extra = () if problem == "field" else RANGE_COLUMNS
    columns = (*COLUMNS[:TIMES], *extra, *COLUMNS[TIMES:])
    return table(columns, [row(point, extra=bool(extra)) for point in points], 4)


def row(point: Mapping[str, Any], *, extra: bool) -> list[str]:
    """Format a point's cells of ``COLUMNS``; ``extra`` inserts those of ``RANGE_COLUMNS``."""
    time_s, memory, errors = (point[name] or {} for name in ("time", "memory", "errors"))
    backend = f"{point['backend']}: {point['device']}" if point["outside"] else point["backend"]
    name = f"**{label(point)}**" if point["exact"] else label(point)
    cells = [backend, name, setting(point), point["precision"]]
    if point["status"] != "ok":
        cells[1] += f" ({point['status']})"
    star = "*" if time_s.get("calls") == 1 else ""
    spread = ", ".join(_per_beam(point, f"call_{which}_s") for which in ("q1", "median", "q3"))
    cells += [_per_beam(point, "call_min_s") + star, spread, _per_beam(point, "processor_s")]
    cells += [_per_beam(point, "launch_min_s"), _text(time_s.get("build_s")), _text(time_s.get("compile_s"))]
    cells += [_text(memory.get(f"{which}_bytes"), 1e-6) for which in ("table", "device")]
    if extra:
        of = errors.get("ranges") or {}
        cells += [_text(of.get(name)) for name in ("median", "p95", "max")]
        cells += [_share(of.get(name)) for name in ("wrong_1", "wrong_2")]
    for kind, names in (("log_p", ("rms", "max")), ("posterior", ("kl", "shift_m")), ("tempered", ("kl",)),
                        ("comparable", ("kl", "tv", "shift_m")), ("fine", ("kl", "shift_m"))):  # fmt: skip
        of = errors.get(kind) or {}
        cells += [_text(of.get(name)) for name in names]
    return cells


def _per_beam(point: Mapping[str, Any], name: str) -> str:
    seconds = (point["time"] or {}).get(name)
    return _text(None if seconds is None else seconds / max(point["work"], 1), 1e9)


def _text(value: float | None, scale: float = 1.0) -> str:
    return "-" if value is None else f"{value * scale:.3g}"


def _share(value: float | None) -> str:
    return "-" if value is None else "0" if value == 0 else f"{100 * value:.2g} %"
