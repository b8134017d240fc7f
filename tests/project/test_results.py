"""Reports in bench/results: each is published by a page, and states its commit and its command."""

from __future__ import annotations

import importlib
import json
import re
from pathlib import Path
from types import ModuleType

import pytest
from support.paths import ROOT

RESULTS = ROOT / "bench" / "results"
PAGES = [*(ROOT / "docs").glob("*.md"), ROOT / "bench" / "RESULTS.md", ROOT / "README.md"]
REPORTS = sorted(file for file in RESULTS.iterdir() if file.suffix in (".md", ".json"))
MOST = 60
COMMIT = re.compile(
    r'commit"?:? "?(?:[0-9a-f]{7,12}|main)|published_with": "[0-9a-f]{7}|Published with commit [0-9a-f]{7}'
)
COMMAND = re.compile(r"(?:python )?bench/[\w/]+\.py")
SCRIPT = re.compile(r"(?:python |\"script\": \")(bench/[\w/]+\.py)")
# Scripts of older reports, by today's names (see bench/RESULTS.md).
FORMER = {
    "absolute": "point_models", "landmarks": "point_models", "localization": "localization_logs",
    "several_scans": "small_calls", "speed": "limits",
}  # fmt: skip
FINISHED = re.compile(r"(?m)^\| (\w+), in \w+ \|")


@pytest.fixture(scope="module")
def published() -> str:
    """Return the text of all pages."""
    return "\n".join(page.read_text(encoding="utf-8") for page in PAGES)


def test_each_report_is_published(published: str) -> None:
    """A page links to it, or the table of a report links to its data file."""
    names = {Path(name).stem for name in re.findall(r"results/([\w.-]+)", published)}
    assert [file.name for file in REPORTS if file.stem not in names] == []


def parts_of(file: Path) -> list[str]:
    """Return the reports of a file: the elements of a list, or the sections of the first level."""
    text = file.read_text(encoding="utf-8")
    if file.suffix == ".json":
        whole = json.loads(text)
        return [json.dumps(one) for one in whole] if isinstance(whole, list) else [text]
    return [part for part in re.split(r"(?m)^(?=# )", text) if part.strip()]


@pytest.mark.parametrize("file", REPORTS, ids=lambda file: file.name)
def test_each_report_states_commit_and_command(file: Path) -> None:
    for part in parts_of(file):
        assert COMMIT.search(part) or "--commit" in part, f"no commit: {part[:80]}"
        assert COMMAND.search(part), f"no command: {part[:80]}"


@pytest.mark.parametrize("file", REPORTS, ids=lambda file: file.name)
def test_scripts_of_reports_are_here(file: Path) -> None:
    """The script of each command exists by its path or name, or RESULTS.md lists it among the finished studies."""
    names = {path.stem for path in (ROOT / "bench").rglob("*.py")}
    finished = FINISHED.findall((ROOT / "bench" / "RESULTS.md").read_text(encoding="utf-8"))
    names |= set(finished)
    for script in SCRIPT.findall(file.read_text(encoding="utf-8")):
        stem = Path(script).stem
        assert (ROOT / script).is_file() or FORMER.get(stem, stem) in names, script


@pytest.fixture
def stiff_density(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Import the script that makes the tables of docs/numerics.md."""
    monkeypatch.syspath_prepend(str(ROOT / "bench"))
    return importlib.import_module("accuracy.stiff_density")


def test_tables_of_extreme_sizes_are_those_of_the_reports(stiff_density: ModuleType) -> None:
    page = (ROOT / "docs" / "numerics.md").read_text(encoding="utf-8")
    for name, lines in importlib.import_module("accuracy.extreme_tables").tables().items():
        assert f"<!-- made: {name} -->\n{lines}\n<!-- end -->" in page, "run bench/accuracy/extreme_tables.py"


def test_reports_stay_few() -> None:
    """Reports without a published figure belong to the history."""
    assert 20 < len(list(RESULTS.iterdir())) <= MOST
