"""The benchmark scripts of matching run on tiny sizes and write their reports."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from support.bench_scripts import run_here, run_script

pytestmark = pytest.mark.long


def test_global_matching_runs(data_dir: Path, needs: Callable[[str], str], tmp_path: Path) -> None:
    report = run_here(
        "studies/global_matching.py", "--data", str(data_dir), "--backend", needs("opencl"), "--part", "window",
        "--part", "olin", "--scans", "2", "--repeats", "1", output=tmp_path / "matching",
    )  # fmt: skip
    assert [row["level"] for row in report["window"]] == [0, 1, 2, 3]
    assert report["window"][0]["evaluated"] == 1 > report["window"][3]["evaluated"]
    (olin,) = report["olin"]
    assert olin["right"] == 1 and olin["found_wrong"] == 0


def test_matching_runs(needs: Callable[[str], str], tmp_path: Path) -> None:
    """Match in generated buildings alone, which need no data."""
    arguments = ["--matches", "6", "--backend", needs("opencl")]
    report = run_here("accuracy/matching.py", *arguments, output=tmp_path / "matching")
    assert len(report["rows"]) == 6
    assert all(row["wrong_percent"] == 0 and row["median_mm"] < 20 for row in report["rows"])


@pytest.mark.slow
def test_match_verdicts_are_measured(needs: Callable[[str], str], tmp_path: Path) -> None:
    """Match corridors and scans of few beams, which need no data."""
    arguments = ["--count", "6", "--backend", needs("opencl"), "--part", "corridors", "--part", "few"]
    rows = run_script("accuracy/match_verdicts.py", *arguments, output=tmp_path / "verdicts")["rows"]
    assert all(float(row["converged %"]) <= 10 for row in rows["corridors"])
    assert len(rows["few"]) == 12
