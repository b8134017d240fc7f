"""Read the reports that docs/error-vs-time.md is made of, as rows of one form; refuse reports of other code."""

from __future__ import annotations

import json
import math
import re
import statistics
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from commits import ROOT, commits_since

from gpusense.evaluation.benchmark.rows import ALL, Row, model_rows, origin_of, titles_of
from gpusense.evaluation.benchmark.stored import read_report

RESULTS = ROOT / "bench" / "results"
PATTERN = "error_vs_time_*_{}.json"
# Folders whose changes make a report old, and the number of commits to them after which it must not be published.
FOLDERS = ("kernels", "gpusense/models", "gpusense/tables", "gpusense/backends")
LIMIT = 100
TASK_MEASURES = {"median": "median error", "p95": "95 % error", "max": "largest error"}
UNITS = {"%": "relative"}
DISCRETE = "gs.DiscreteBeamModel(gs.BeamParameters(), range_max=scanner.range_max)"
# Relative standard deviation of a run's median error by need, for reports of few runs.
SPREAD = {"localisation": 0.15, "learning": 0.3}


@dataclass(frozen=True)
class Source:
    """A report.

    Attributes:
        name: Name of its file.
        kind: ``"models"`` or ``"tasks"``.
        report: Its contents.
        titles: Titles of its devices.
    """

    name: str
    kind: str
    report: Mapping[str, Any]
    titles: tuple[str, ...]

    @property
    def missing(self) -> str:
        """Return a phrase with the number of points or settings, and of those left out or failed."""
        points = self.report["points" if self.kind == "models" else "rows"]
        lost = sum(one["status"] != "ok" if self.kind == "models" else one["seconds"] is None for one in points)
        return f"{lost} of {len(points)}"


# ---- commits


def commit_trouble(commit: str, *, root: Path = ROOT, limit: int = LIMIT, folders: Sequence[str] = FOLDERS) -> str:
    """Return why a report of a commit must not be published; empty if it may.

    Args:
        commit: The commit that the report states.
        root: The checkout, with its history.
        limit: Most commits to ``folders`` since then.
        folders: The code that the report measures.
    """
    if not commit or commit.endswith("+"):
        return f"is of a checkout with uncommitted changes: {commit or 'no commit'}"
    since = commits_since(commit, folders, root=root, ancestor=True)
    if math.isinf(since):
        return f"is of {commit}, which is no commit of this history"
    return f"is of {commit}, {since} commits to {', '.join(folders)} ago, more than {limit}" if since > limit else ""


# ---- reports


def sources(folder: Path = RESULTS) -> list[Source]:
    """Read all reports of a folder, those of processors first.

    Raises:
        ValueError: A report is damaged, or of uncommitted changes, or two are of the same device.
    """
    found = []
    for kind, read in (("models", read_report), ("tasks", read_tasks)):
        for file in sorted(folder.glob(PATTERN.format(kind))):
            report = read(file)
            if not report["commit"] or report["commit"].endswith("+"):
                raise ValueError(f"{file.name}: {commit_trouble(report['commit'] or '')}")
            points = report["points" if kind == "models" else "rows"]
            named = titles_of(
                (p for p in points if p["backend"] != "outside"), report["machine"], report.get("devices", ())
            )
            found.append(Source(file.name, kind, report, tuple(named.values())))
    kinds = [(source.kind, title) for source in found for title in source.titles]
    twice = {name for name in kinds if kinds.count(name) > 1}
    if twice:
        raise ValueError(f"reports: each device must have one of a kind, got several of {sorted(twice)}")
    return sorted(found, key=_place)


def _place(source: Source) -> tuple[bool, str, str]:
    """Return the sort key of a report: processors first, and a variant after the device that it varies."""
    device = source.name.removesuffix(f"_{source.kind}.json")
    return any("NVIDIA" in title for title in source.titles), device, source.kind


def read_tasks(file: Path) -> dict[str, Any]:
    """Read a report of needs.py.

    Raises:
        ValueError: The file is not such a report.
    """
    report = json.loads(file.read_text(encoding="utf-8"))
    if not isinstance(report, dict) or report.get("kind") != "needs" or report.get("schema") != 1:
        raise ValueError(f"{file.name}: must be a report of bench/error_vs_time/needs.py")
    return report


# ---- rows


def task_rows(report: Mapping[str, Any]) -> list[Row]:
    """Return the rows of a report of needs.py."""
    rows, titles, origin = [], titles_of(report["rows"], report["machine"]), origin_of(report)
    for one in report["rows"]:
        if one["seconds"] is None:
            continue
        unit = UNITS.get(one["unit"], one["unit"])
        errors = {text: one["error"][name] for name, text in TASK_MEASURES.items()}
        quartiles = tuple(one["seconds"][name] for name in ("q1", "median", "q3"))
        seconds = one["seconds"]["median"] if one["kind"] == "gpu" else one["processor_s"]
        rows.append(
            Row(
                one["need"], titles[one["backend"]], ALL, one["method"], one["setting"], one["precision"],
                code_of(one["code"]), seconds, quartiles, errors, dict.fromkeys(errors, unit),
                outside=one.get("outside", ""), origin=origin, doubt=doubt(one),
            )
        )  # fmt: skip
    return rows


def code_of(text: str) -> str:
    """Return the code of a row; reports of 2026-11-26 and before name neither map nor laser."""
    text = text.replace("gs.BeamModel(gs.BeamParameters, ", "gs.BeamModel(").replace(
        "(gs.DiscreteBeamModel, ", f"({DISCRETE}, "
    )
    return re.sub(r"(gs\.(?:LikelihoodField|Beam)Model)\((?=beams|gs\.Discrete)", r"\1(grid, scanner, ", text)


def doubt(row: Mapping[str, Any]) -> float:
    """Return the factor by which the error of other seeds may exceed a row's error, at two standard deviations."""
    errors = row.get("by_run", {}).get("error", ())
    spread = SPREAD.get(row["need"], 0.0)
    if len(errors) > 2 and spread:
        middle = statistics.fmean(errors)
        spread = statistics.stdev(errors) / middle if middle else 0.0
    return float(1 + 2 * spread / math.sqrt(row["runs"]))


ROWS: dict[str, Callable[[Mapping[str, Any]], list[Row]]] = {"models": model_rows, "tasks": task_rows}


def rows_of(found: Sequence[Source]) -> list[Row]:
    """Return the rows of all reports."""
    return [row for source in found for row in ROWS[source.kind](source.report)]
