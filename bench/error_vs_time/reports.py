"""Read and write the reports behind docs/error-vs-time.md; refuse reports of other code.

A report file holds the fields that the page shows. ``same`` lists the fields with a single value, ``lines`` contains a
row for each point or task, and a row refers to strings by their index in ``texts``.
"""

from __future__ import annotations

import json
import math
import statistics
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from common import ROOT, git

from gpusense._util.files import write_whole
from gpusense.evaluation.benchmark.report import ALL, MODEL_MEASURES, Row, model_rows, origin_of

RESULTS = ROOT / "bench" / "results"
PATTERN = "error_vs_time_*_{}.json"
# Folders whose changes make a report old, and the number of commits to them after which it must not be published.
FOLDERS = ("kernels", "gpusense/models", "gpusense/tables", "gpusense/backends")
LIMIT = 150
# Subjects of commits that change docstrings, comments, type hints and names of classes only: they do not count.
WORDS_ONLY = (
    "docstring|comments|sentences|error sections|aliases of array types|^Describe (internal|the search)|^State "
    "(shapes|arguments|how rays)|^Name (buffers|classes|modules|the bound calls)"
)
TASK_MEASURES = {"median": "median error", "p95": "95 % error", "max": "largest error"}
UNITS = {"%": "relative"}
# The list and the version of each kind of report.
LISTS = {"models": "points", "tasks": "rows"}
SCHEMAS = {"models": 2, "tasks": 1}
POINT = (
    "scene", "cloud", "problem", "backend", "device", "kind", "method", "variant", "knob", "value", "code", "precision",
    "exact", "outside", "particles", "beams", "work", "checked", "status", "reason",
    *(f"time.{name}" for name in ("call_min_s", "call_q1_s", "call_median_s", "call_q3_s", "processor_s")),
    *dict.fromkeys(".".join(("errors", *place)) for each in MODEL_MEASURES.values() for place, *_ in each),
)  # fmt: skip
"""Fields of a point that a report file holds."""
# Relative standard deviation of a run's median error by need, for reports of few runs.
SPREAD = {"localisation": 0.15, "learning": 0.3}


@dataclass(frozen=True)
class Source:
    """A report.

    Attributes:
        kind: ``"models"`` or ``"tasks"``.
    """

    name: str
    kind: str
    report: Mapping[str, Any]
    titles: tuple[str, ...]

    @property
    def missing(self) -> str:
        """Return a phrase with the number of points or settings, and of those left out or failed."""
        points = self.report[LISTS[self.kind]]
        lost = sum(one["status"] != "ok" if self.kind == "models" else one["seconds"] is None for one in points)
        return f"{lost} of {len(points)}"


# ---- commits


def has_history(root: Path = ROOT) -> bool:
    """Return whether the folder is a checkout with its whole history."""
    try:
        own = Path(git("rev-parse", "--show-toplevel", root=root)).resolve() == root.resolve()
        return own and git("rev-parse", "--is-shallow-repository", root=root) == "false"
    except (OSError, subprocess.SubprocessError):
        return False


@cache
def _commits_since(commit: str, folders: tuple[str, ...], root: Path) -> float:
    """Count the later commits to folders that change code; infinite where HEAD does not descend from the commit."""
    try:
        git("merge-base", "--is-ancestor", commit, "HEAD", root=root)
        words = ("-i", "-E", "--invert-grep", f"--grep={WORDS_ONLY}")
        return int(git("rev-list", "--count", *words, f"{commit}..HEAD", "--", *folders, root=root))
    except subprocess.CalledProcessError:
        return math.inf


def commit_trouble(commit: str, *, root: Path = ROOT, limit: int = LIMIT, folders: Sequence[str] = FOLDERS) -> str:
    """Return why a report of a commit must not be published; empty if it may."""
    if not commit or commit.endswith("+"):
        return f"is of a checkout with uncommitted changes: {commit or 'no commit'}"
    since = _commits_since(commit, tuple(folders), root)
    if math.isinf(since):
        return f"is of {commit}, which is no commit of this history"
    return f"is of {commit}, {since} commits to {', '.join(folders)} ago, more than {limit}" if since > limit else ""


# ---- reports


def sources(folder: Path = RESULTS) -> list[Source]:
    """Read all reports of a folder, processors first."""
    found = []
    for kind in LISTS:
        for file in sorted(folder.glob(PATTERN.format(kind))):
            report = read(file, kind)
            if not report["commit"] or report["commit"].endswith("+"):
                raise ValueError(f"{file.name}: {commit_trouble(report['commit'] or '')}")
            named = [title for name, title in titles_of(report, kind).items() if name != "outside"]
            found.append(Source(file.name, kind, report, tuple(named)))
    kinds = [(source.kind, title) for source in found for title in source.titles]
    twice = {name for name in kinds if kinds.count(name) > 1}
    if twice:
        raise ValueError(f"reports: each device must have one of a kind, got several of {sorted(twice)}")
    return sorted(found, key=_place)


def _place(source: Source) -> tuple[bool, str, str]:
    """Return the sort key of a report: processors first, and a variant after the device that it varies."""
    device = source.name.removesuffix(f"_{source.kind}.json")
    return any("NVIDIA" in title for title in source.titles), device, source.kind


# ---- files


def write(file: Path, report: Mapping[str, Any], kind: str) -> None:
    """Write the fields of a report that the page shows."""
    flat = [_flat(one) for one in report[LISTS[kind]]]
    fields = [name for name in dict.fromkeys(name for one in flat for name in one) if kind == "tasks" or name in POINT]
    columns = {name: [one.get(name) for one in flat] for name in fields}
    same = {name: column[0] for name, column in columns.items() if all(value == column[0] for value in column)}
    texts: dict[str, list[Any]] = {}
    for name in fields:
        if name not in same and any(isinstance(value, (str, bool)) for value in columns[name]):
            texts[name] = list(dict.fromkeys(columns[name]))
            columns[name] = [texts[name].index(value) for value in columns[name]]
    varied = [name for name in fields if name not in same]
    lines = list(zip(*(columns[name] for name in varied), strict=True)) if varied else [()] * len(flat)
    left_out = (LISTS[kind], "profiles", "absent", "truth")
    head = {name: value for name, value in report.items() if name not in left_out}
    head |= {"same": same, "texts": texts, "fields": varied}
    if "scenes" in head:
        head["scenes"] = [{name: scene.get(name) for name in ("name", "fingerprint")} for scene in head["scenes"]]
    parts = [f"{json.dumps(name)}: {_json(value)}" for name, value in head.items()]
    parts.append('"lines": [\n' + ",\n".join(map(_json, lines)) + "\n]")
    write_whole(file, lambda stream: stream.write(("{" + ",\n".join(parts) + "}\n").encode()))


def _json(value: Any) -> str:
    return json.dumps(value, allow_nan=False, separators=(",", ":"))


def read(file: Path, kind: str) -> dict[str, Any]:
    """Read a report file."""
    report = json.loads(file.read_text(encoding="utf-8"))
    if not isinstance(report, dict) or report.get("schema") != SCHEMAS[kind]:
        raise ValueError(f"{file.name}: must be a report of {kind} by bench/error_vs_time/measure.py")
    if LISTS[kind] not in report:
        same, texts, fields, lines = (report.pop(key) for key in ("same", "texts", "fields", "lines"))
        report[LISTS[kind]] = [
            _nested(same | {n: texts[n][v] if n in texts else v for n, v in zip(fields, line, strict=True)})
            for line in lines
        ]
    return report


def _flat(value: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested fields by dotted names."""
    found: dict[str, Any] = {}
    for name, item in value.items():
        found |= _flat(item, f"{prefix}{name}.") if isinstance(item, Mapping) else {prefix + name: item}
    return found


def _nested(flat: Mapping[str, Any]) -> Any:
    """Return fields with dotted names as nested ones; a mapping of nothing but None is None."""
    if all(value is None for value in flat.values()):
        return None
    inner: dict[str, dict[str, Any]] = {}
    for name, value in flat.items():
        head, dot, rest = name.partition(".")
        if dot:
            inner.setdefault(head, {})[rest] = value
    plain = {name: value for name, value in flat.items() if "." not in name}
    return plain | {name: _nested(value) for name, value in inner.items()}


# ---- rows


def title_of(point: Mapping[str, Any], machine: Mapping[str, Any], driver: str = "", target: str = "") -> str:
    """Name a point's device: library, and processor with cores or GPU; PoCL's ``target`` "haswell" has no AVX-512."""
    library = {"opencl": "Intel's OpenCL" if driver.startswith("Intel") else "OpenCL", "warp:cuda": "CUDA",
               "warp:cpu": "Warp"}  # fmt: skip
    made = next((text for name, text in library.items() if point["backend"].startswith(name)), "NumPy")
    if point["kind"] == "gpu":
        return f"{point['device']}, {made}"
    made = "PoCL" if "pthread" in point["device"] or "cpu-" in point["device"] else made
    made += ", AVX2 only" if target == "haswell" else ""
    cores = 1 if point["backend"].startswith("warp:cpu") else machine["processors"]
    return f"{cores} core{'s' * (cores > 1)} of an {machine['processor']}, {made}"


def titles_of(report: Mapping[str, Any], kind: str) -> dict[str, str]:
    """Return a title for each device of a report, by selection string; equal titles are extended by device names.

    Other implementations (selection string ``"outside"``) have the title of the first processor.
    """
    drivers = {one["selection"]: (one["driver"], one.get("target", "")) for one in report.get("devices", ())}
    first: dict[str, Mapping[str, Any]] = {}
    for point in report[LISTS[kind]]:
        first.setdefault(point["backend"], point)
    outside = first.pop("outside", None)
    plain = {name: title_of(point, report["machine"], *drivers.get(name, ())) for name, point in first.items()}
    alike = list(plain.values())
    titles = {name: f"{title}, {name}" if alike.count(title) > 1 else title for name, title in plain.items()}
    if outside is not None:
        own = next((titles[name] for name, point in first.items() if point["kind"] == outside["kind"]), None)
        titles["outside"] = own or next(iter(titles.values()), title_of(outside, report["machine"]))
    return titles


def task_rows(report: Mapping[str, Any]) -> list[Row]:
    """Return the rows of a report of needs.py."""
    rows, titles, origin = [], titles_of(report, "tasks"), origin_of(report)
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
                one["code"], seconds, quartiles, errors, dict.fromkeys(errors, unit),
                outside=one.get("outside") or "", origin=origin, doubt=doubt(one),
            )
        )  # fmt: skip
    return rows


def doubt(row: Mapping[str, Any]) -> float:
    """Return the factor by which the error of other seeds may exceed a row's error, at two standard deviations."""
    errors = (row.get("by_run") or {}).get("error") or ()
    spread = SPREAD.get(row["need"], 0.0)
    if len(errors) > 2 and spread:
        middle = statistics.fmean(errors)
        spread = statistics.stdev(errors) / middle if middle else 0.0
    return float(1 + 2 * spread / math.sqrt(row["runs"]))


ROWS: dict[str, Callable[[Mapping[str, Any]], list[Row]]] = {
    "models": lambda report: model_rows(report, titles_of(report, "models")), "tasks": task_rows,
}  # fmt: skip


def rows_of(found: Sequence[Source]) -> list[Row]:
    """Return the rows of all reports."""
    return [row for source in found for row in ROWS[source.kind](source.report)]
