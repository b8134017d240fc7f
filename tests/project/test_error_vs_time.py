"""docs/error-vs-time.md comes from committed reports of current code; the interactive page in Node and Chromium."""

from __future__ import annotations

import importlib
import json
import math
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from support.bench_world import made_point
from support.paths import ROOT

DEVICE, WISH = "2 cores of an X, PoCL", "localisation to 2 cm"


@pytest.fixture(scope="module")
def page() -> ModuleType:
    """Import the script that makes the page."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "bench"))
        return importlib.import_module("error_vs_time.page")


@pytest.fixture(scope="module")
def reports(page: ModuleType) -> ModuleType:
    """Import the module that reads the reports."""
    return importlib.import_module("error_vs_time.reports")


# ---- the committed page and reports


def test_the_page_is_what_the_reports_give(page: ModuleType) -> None:
    """Page and figures agree byte for byte; no other output is committed."""
    made = page.files()
    assert {path for path, text in made.items() if (ROOT / path).read_bytes() != text.encode()} == set(), (
        "run python bench/error_vs_time/page.py"
    )
    figures = {path.relative_to(ROOT) for path in (ROOT / "docs" / "img").glob("error-vs-time*")}
    assert figures == {path for path in made if path.suffix == ".svg"}
    assert "{{" not in made[page.PAGE] and f"python {Path(page.__file__).relative_to(ROOT)}" in made[page.PAGE]


def test_reports_are_of_this_code(reports: ModuleType) -> None:
    if not reports.has_history():
        pytest.skip("the checkout has no history, or a part of it only")
    found = {source.name: reports.commit_trouble(source.report["commit"]) for source in reports.sources()}
    assert {name: trouble for name, trouble in found.items() if trouble} == {} and found


@pytest.mark.parametrize(("devices", "titles"), [
    ({"opencl:0:0": "Intel(R) OpenCL 1", "opencl:1:0": "A"}, ["Intel's OpenCL", "OpenCL"]),
    ({"opencl:0:0": "A", "opencl:1:0": "A"}, ["OpenCL, opencl:0:0", "OpenCL, opencl:1:0"]),
])  # fmt: skip
def test_titles_tell_devices_apart(reports: ModuleType, devices: dict[str, str], titles: list[str]) -> None:
    points = [made_point(backend=name, device="X") for name in devices] + [made_point(backend="outside", outside=True)]
    listed = [{"selection": name, "driver": driver} for name, driver in devices.items()]
    report = {"points": points, "machine": {"processors": 2, "processor": "X"}, "devices": listed}
    named = reports.titles_of(report, "models")
    assert list(named.values()) == [f"2 cores of an X, {title}" for title in (*titles, titles[0])]


def test_reports_state_command_and_device(reports: ModuleType) -> None:
    for source in reports.sources():
        assert re.match("python bench/error_vs_time/", source.report["command"]), source.name
        assert source.titles and source.report["date"] and "/work" not in source.report["command"]
        assert "--quick" not in source.report["command"], f"{source.name}: of 512 particles"


def test_a_report_is_stored_as_a_table(reports: ModuleType, tmp_path: Path) -> None:
    """A stored report has the same rows; results in git stay small; a report of another form is refused."""
    failed = task("icp", "", 1, 1) | {"seconds": None, "error": None, "processor_s": None}
    lists = {
        "tasks": [task("beam", "9 x 6", 1.5, 0.25), task("field", "8 x 6", 2.5, 0.5, outside="x 1"), failed],
        "models": [
            made_point(method="dda"), made_point(method="lookup", knob="bins", value=32, exact=True),
            made_point(cloud="tracking", status="left out", time=None, errors=None),
        ],
    }  # fmt: skip
    for kind, rows in lists.items():
        head = {"schema": reports.SCHEMAS[kind], "machine": {"processors": 2, "processor": "X"}, "date": "2026-01-01",
                "commit": "abc", "command": "python x"}  # fmt: skip
        report = head | {reports.LISTS[kind]: rows}
        reports.write(tmp_path / "x", report, kind)
        stored = reports.read(tmp_path / "x", kind)
        assert reports.ROWS[kind](stored) == reports.ROWS[kind](report) and reports.ROWS[kind](report)
        assert {name: stored[name] for name in head} == head
        assert (reports.Source("x", kind, stored, ()).missing)[0] == "1"
        (tmp_path / "x").write_text(json.dumps(head | {"schema": 7, reports.LISTS[kind]: []}))
        with pytest.raises(ValueError, match=f"must be a report of {kind}"):
            reports.read(tmp_path / "x", kind)
    assert sum(file.stat().st_size for file in reports.RESULTS.iterdir()) < 1.2e6


# ---- reports of two methods


def task(method: str, setting: str, seconds: float, error: float, **changes: Any) -> dict[str, Any]:
    return {
        "need": "localisation", "backend": "opencl:0:0", "device": "pthread-X", "kind": "cpu", "method": method,
        "setting": setting, "code": f"make({method})", "precision": "float32", "unit": "m", "runs": 3, "reason": "",
        "seconds": {"q1": seconds, "median": 2 * seconds, "q3": 3 * seconds, "min": seconds},
        "processor_s": seconds, "error": {"q1": error, "median": error, "q3": error, "p95": 2 * error, "max": 9.0},
    } | changes  # fmt: skip


def test_the_doubt_of_an_error_by_hand(reports: ModuleType) -> None:
    """The doubt is two standard deviations of the mean, by the runs if there are three, otherwise by the need."""
    runs = {"by_run": {"error": [0.9, 1.1, 1.0, 1.0]}, "runs": 4}
    assert reports.doubt(task("beam", "", 1, 1) | runs) == pytest.approx(1 + math.sqrt(0.02 / 3))
    assert reports.doubt(task("beam", "", 1, 1, runs=1)) == pytest.approx(1.3)
    assert reports.doubt(task("icp", "", 1, 1, need="matching")) == 1.0


def write_tasks(folder: Path, rows: list[dict[str, Any]], commit: str = "abc") -> None:
    report = {
        "schema": 1, "kind": "needs", "date": "2026-01-01", "commit": commit, "command": "python x",
        "machine": {"processors": 2, "processor": "X"}, "rows": rows,
    }  # fmt: skip
    (folder / "error_vs_time_x_tasks.json").write_text(json.dumps(report))


ROWS = [
    task("field", "10000 x 60", 0.008, 0.018), task("beam", "10000 x 60", 0.05, 0.005),
    task("field", "1000 x 60", 0.002, 0.017), task("field", "100 x 60", 0.001, 0.05),
    task("beam", "1000 x 60", 0.009, 0.006), task("beam", "1000 x 60, temperature 1", 0.001, 0.001),
]  # fmt: skip


def test_the_answers_by_hand(page: ModuleType, tmp_path: Path) -> None:
    write_tasks(tmp_path, ROWS)
    text = page.files(tmp_path)[page.PAGE]
    assert f"| to do | {DEVICE} |" in text
    assert "| 10 000 particles at 100 Hz | **field, 10000 x 60**: 8 ms, 1.8 cm |" in text
    first = f"**10 000 particles at 100 Hz:**\n\n- {DEVICE}: **field, 10000 x 60**: 8 ms (16 ms elapsed), 1.8 cm\n\n"
    assert f"{first}```python\nprocessor = make(field)\n```\n" in text
    assert "| 1000 particles at 100 Hz | **beam, 1000 x 60**: 9 ms, 6 mm |" in text
    # A temperature of 1 is not the default: it is right only in simulations.
    assert "| localisation to 2 cm | **field, 1000 x 60**: 2 ms, 1.7 cm |" in text
    # Nothing measured a beam model alone.
    assert "beam model, at most 1 ms" not in text


def test_reports_of_uncommitted_changes_are_refused(page: ModuleType, tmp_path: Path) -> None:
    write_tasks(tmp_path, ROWS, commit="abc+")
    with pytest.raises(ValueError, match="uncommitted changes: abc\\+"):
        page.files(tmp_path)
    with pytest.raises(ValueError, match="must have reports"):
        page.files(tmp_path / "none")


# ---- the interactive page


def test_the_interactive_page_fetches_nothing(page: ModuleType) -> None:
    text = page.interactive().replace("http://www.w3.org/2000/svg", "").replace('href="../docs/error-vs-time.html"', "")
    assert not re.search(r"https?:|\bsrc=|\bhref=|\bimport\b|\bfetch\(|XMLHttp|@import|url\(|\{(script|data)\}", text)
