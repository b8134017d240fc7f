"""Read the reports that docs/error-vs-time.md is made of, as rows of one form; refuse reports of other code."""

from __future__ import annotations

import json
import math
import subprocess
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gpusense.evaluation.benchmark.choice import Entry
from gpusense.evaluation.benchmark.profiles import error_of, label, setting
from gpusense.evaluation.benchmark.stored import read_report

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "bench" / "results"
PATTERN = "error_vs_time_*_{}.json"
# Code whose changes make a report old, and the commits to it after which the report is too old to be published.
FOLDERS = ("kernels", "gpusense/models", "gpusense/tables", "gpusense/backends")
LIMIT = 100
ALL = "all maps"
NEEDS = {"ranges": "rays", "beam": "beam model", "field": "likelihood field"}
# By need: its measures as (place in a point, cloud or "" for all, text, unit); the first one is that of its limit.
MODEL_MEASURES = {
    "rays": (
        (("ranges", "wrong_1"), "", "rays wrong by more than a cell", "share"),
        (("ranges", "median"), "", "median error of a ray", "cells"),
        (("ranges", "p95"), "", "95 % error of a ray", "cells"),
        (("ranges", "max"), "", "largest error of a ray", "cells"),
    ),
    "beam model": (
        (("comparable", "kl"), "tracking", "KL divergence at a comparable temperature", "nats"),
        (("comparable", "kl"), "global", "the same, all over the map", "nats"),
        (("fine", "kl"), "tracking", "KL divergence from the true posterior", "nats"),
        (("comparable", "shift_m"), "tracking", "shift of the mean position", "m"),
        (("log_p", "rms"), "tracking", "RMS error of log p", "nats"),
    ),
}
MODEL_MEASURES["likelihood field"] = MODEL_MEASURES["beam model"]
TASK_MEASURES = {"median": "median error", "p95": "95 % error", "max": "largest error"}
UNITS = {"%": "relative"}


@dataclass(frozen=True)
class Row:
    """A method on a device, in one map or in all.

    Attributes:
        need: What it is for.
        device: Title of the device.
        scene: Name of the map; ``ALL`` for the worst error and the mean time of all.
        method, setting, precision, code: As in the reports.
        seconds: Time of a call, a step or a match: of a processor its own time over all cores, of a GPU the least.
        quartiles: Quartiles of the elapsed times [s]; geometric means over the maps.
        errors: By the text of the measure.
        units: Their units.
        exact: Whether it computes the model itself.
        outside: Version and threads of another implementation; empty for gpusense.
        work: Rays or readings of a call; 1 for tasks.
        maps: "8 of 10 clouds" where others were left out, for the time that a table takes; no choice falls on it.
    """

    need: str
    device: str
    scene: str
    method: str
    setting: str
    precision: str
    code: str
    seconds: float
    quartiles: tuple[float, float, float]
    errors: Mapping[str, float]
    units: Mapping[str, str]
    exact: bool = False
    outside: str = ""
    work: int = 1
    maps: str = ""

    @property
    def text(self) -> str:
        """Name the method with setting and precision; float32 is not named."""
        precision = self.precision if self.precision != "float32" and self.need != "learning" else ""
        text = ", ".join(word for word in (self.method, self.setting, precision) if word)
        return f"{text} ({self.maps})" if self.maps else text

    def entry(self, measure: str) -> Entry:
        """Return the row as an entry to choose from, by one of its measures."""
        return Entry(
            self.device, self.method, self.setting, self.precision, self.errors[measure], self.seconds, self.code,
            self.exact,
        )  # fmt: skip


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
        """Say how many points or settings were left out or failed, of how many."""
        points = self.report["points" if self.kind == "models" else "rows"]
        lost = sum(one["status"] != "ok" if self.kind == "models" else one["seconds"] is None for one in points)
        return f"{lost} of {len(points)}"


# ---- commits


def git(*words: str, root: Path = ROOT) -> str:
    """Return the output of git."""
    command = ["git", "-C", str(root), *words]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout.strip()


def has_history(root: Path = ROOT) -> bool:
    """Return whether the folder is a checkout with its whole history."""
    try:
        own = Path(git("rev-parse", "--show-toplevel", root=root)).resolve() == root.resolve()
        return own and git("rev-parse", "--is-shallow-repository", root=root) == "false"
    except (OSError, subprocess.SubprocessError):
        return False


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
    try:
        git("merge-base", "--is-ancestor", commit, "HEAD", root=root)
    except subprocess.CalledProcessError:
        return f"is of {commit}, which is no commit of this history"
    since = int(git("rev-list", "--count", f"{commit}..HEAD", "--", *folders, root=root))
    return f"is of {commit}, {since} commits to {', '.join(folders)} ago, more than {limit}" if since > limit else ""


# ---- reports


def sources(folder: Path = RESULTS) -> list[Source]:
    """Read all reports of a folder, those of processors first.

    Raises:
        ValueError: a report is damaged, or of uncommitted changes, or two are of the same device.
    """
    found = []
    for kind, read in (("models", read_report), ("tasks", read_tasks)):
        for file in sorted(folder.glob(PATTERN.format(kind))):
            report = read(file)
            if not report["commit"] or report["commit"].endswith("+"):
                raise ValueError(f"{file.name}: {commit_trouble(report['commit'] or '')}")
            points = report["points" if kind == "models" else "rows"]
            titles = tuple(dict.fromkeys(title_of(p, report["machine"]) for p in points if p["backend"] != "outside"))
            found.append(Source(file.name, kind, report, titles))
    named = [(source.kind, title) for source in found for title in source.titles]
    twice = {name for name in named if named.count(name) > 1}
    if twice:
        raise ValueError(f"reports: each device must have one of a kind, got several of {sorted(twice)}")
    return sorted(found, key=lambda source: (any("NVIDIA" in title for title in source.titles), source.name))


def read_tasks(file: Path) -> dict[str, Any]:
    """Read a report of needs.py.

    Raises:
        ValueError: it is none.
    """
    report = json.loads(file.read_text(encoding="utf-8"))
    if not isinstance(report, dict) or report.get("kind") != "needs" or report.get("schema") != 1:
        raise ValueError(f"{file.name}: must be a report of bench/error_vs_time/needs.py")
    return report


def title_of(point: Mapping[str, Any], machine: Mapping[str, Any]) -> str:
    """Name the device of a point: its library, and the processor with its cores or the GPU."""
    library = {"opencl": "OpenCL", "warp:cuda": "CUDA", "warp:cpu": "Warp"}
    prefix = next((name for name in ("warp:cuda", "warp:cpu", "opencl") if point["backend"].startswith(name)), "")
    if point["kind"] == "gpu":
        return f"{point['device']}, {library[prefix]}"
    made = "PoCL" if "pthread" in point["device"] or "cpu-" in point["device"] else library.get(prefix, "NumPy")
    cores = 1 if prefix == "warp:cpu" else machine["processors"]
    return f"{cores} core{'s' * (cores > 1)} of an {machine['processor']}, {made}"


# ---- rows


def mean(numbers: Iterable[float]) -> float:
    """Return the geometric mean of positive numbers."""
    logs = [math.log(number) for number in numbers]
    return math.exp(sum(logs) / len(logs))


def seconds_of(point: Mapping[str, Any]) -> float | None:
    """Return the time of a point: the processor's own on a processor, the least elapsed one on a GPU."""
    name = "call_min_s" if point["kind"] == "gpu" else "processor_s"
    value = (point["time"] or {}).get(name)
    return float(value) if value else None


def model_rows(source: Source) -> list[Row]:
    """Return the rows of a report of ``gpusense bench``, for each map and for all together."""
    machine, groups = source.report["machine"], {}
    for point in source.report["points"]:
        backend, precision = point["backend"], point["precision"]
        key = (NEEDS[point["problem"]], backend, point["device"], label(point), setting(point), precision)
        groups.setdefault(key, []).append(point)
    everywhere = {}
    for (need, backend, *_, precision), group in groups.items():
        seen = everywhere.setdefault((need, backend, precision), set())
        seen |= {(point["scene"], point["cloud"]) for point in group}
    rows = []
    for (need, backend, *_, precision), group in groups.items():
        title = source.titles[0] if backend == "outside" else title_of(group[0], machine)
        for scene in [*dict.fromkeys(point["scene"] for point in group), ALL]:
            part = group if scene == ALL else [point for point in group if point["scene"] == scene]
            part = [point for point in part if point["status"] != "left out"]
            there, whole = len(part), len(everywhere[need, backend, precision])
            made = _model_row(need, title, scene, part) if part else None
            if made is not None:
                some = scene == ALL and there < whole
                rows.append(replace(made, maps=f"{there} of {whole} clouds") if some else made)
    return rows


def _model_row(need: str, title: str, scene: str, group: Sequence[Mapping[str, Any]]) -> Row | None:
    times = [seconds_of(point) for point in group]
    if any(time is None or point["status"] != "ok" for time, point in zip(times, group, strict=True)):
        return None
    errors, units = {}, {}
    for place, cloud, text, unit in MODEL_MEASURES[need]:
        part = [point for point in group if cloud in ("", point["cloud"])]
        known = [value for point in part if (value := error_of(point, *place)) is not None]
        if known:
            errors[text], units[text] = max(known), unit
    first = group[0]
    quartiles = tuple(mean(point["time"][f"call_{name}_s"] for point in group) for name in ("q1", "median", "q3"))
    return Row(
        need, title, scene, label(first), setting(first), first["precision"], first["code"],
        mean(time or 1.0 for time in times), quartiles, errors, units, bool(first["exact"]),
        first["device"] if first["outside"] else "", first["work"],
    )  # fmt: skip


def task_rows(source: Source) -> list[Row]:
    """Return the rows of a report of needs.py."""
    rows = []
    for one in source.report["rows"]:
        if one["seconds"] is None:
            continue
        unit = UNITS.get(one["unit"], one["unit"])
        errors = {text: one["error"][name] for name, text in TASK_MEASURES.items()}
        quartiles = tuple(one["seconds"][name] for name in ("q1", "median", "q3"))
        seconds = one["seconds"]["median"] if one["kind"] == "gpu" else one["processor_s"]
        rows.append(
            Row(
                one["need"], title_of(one, source.report["machine"]), ALL, one["method"], one["setting"],
                one["precision"], one["code"], seconds, quartiles, errors, dict.fromkeys(errors, unit),
            )
        )  # fmt: skip
    return rows


ROWS: dict[str, Callable[[Source], list[Row]]] = {"models": model_rows, "tasks": task_rows}


def rows_of(found: Sequence[Source]) -> list[Row]:
    """Return the rows of all reports."""
    return [row for source in found for row in ROWS[source.kind](source)]
