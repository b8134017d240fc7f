"""Reports in bench/results: each is published by a page, and states its commit and its command."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from support.paths import ROOT

RESULTS = ROOT / "bench" / "results"
PAGES = [*(ROOT / "docs").glob("*.md"), ROOT / "bench" / "RESULTS.md", ROOT / "README.md"]
REPORTS = sorted(file for file in RESULTS.iterdir() if file.suffix in (".md", ".json"))
MOST = 100
COMMIT = re.compile(
    r'commit"?:? "?(?:[0-9a-f]{7,12}|main)|published_with": "[0-9a-f]{7}|Published with commit [0-9a-f]{7}'
)
COMMAND = re.compile(r"(?:python )?bench/[\w/]+\.py")


@pytest.fixture(scope="module")
def published() -> str:
    """Return the text of all pages."""
    return "\n".join(page.read_text(encoding="utf-8") for page in PAGES)


def test_each_report_is_published(published: str) -> None:
    """A page links it, or the table of a report links the file beside it."""
    names = {Path(name).stem for name in re.findall(r"results/([\w.-]+)", published)}
    names |= {f"extreme-{device}" for device in ("cpu", "h200") if "results/extreme-" in published}
    assert [file.name for file in REPORTS if file.stem not in names] == []


@pytest.mark.parametrize("file", REPORTS, ids=lambda file: file.name)
def test_each_report_states_commit_and_command(file: Path) -> None:
    text = file.read_text(encoding="utf-8")
    assert COMMIT.search(text) or "--commit" in text, "no commit"
    assert COMMAND.search(text), "no command"


def test_reports_stay_few() -> None:
    """Reports that no figure comes from belong to the history."""
    assert 20 < len(list(RESULTS.iterdir())) <= MOST
