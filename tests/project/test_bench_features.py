"""The benchmark script of features runs on tiny sizes and writes its report."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from support.bench_scripts import BENCH, run_script

pytestmark = pytest.mark.long


@pytest.mark.slow
def test_features_are_measured(data_dir: Path, needs: Callable[[str], str], tmp_path: Path) -> None:
    """Measure simulated floors, scans of one recording, and rates."""
    report = run_script(
        "accuracy/features.py", "--data", str(data_dir), "--backend", needs("opencl"), "--floors", "1", "--scans", "2",
        "--every", "12", "--limit", "20", "--repeats", "1", "--parts", "simulated", "real", "rates",
        output=tmp_path / "features",
    )  # fmt: skip
    assert report["simulated"]["360 0.01 line"]["recall"] > 0.9
    assert report["simulated"]["360 0.01 line"]["precision"] > 0.9
    assert 0.3 < report["simulated"]["1081 0.03 line"]["nees"] < 3
    corners = report["real"]["jarvis-nav350 corner"]
    assert corners["expected"] >= corners["again"] >= corners["within_3_sigma"] > 0
    assert all(row["scans_per_s"] > 0 for row in report["rates"].values())


@pytest.mark.slow
def test_a_scan_with_its_features_is_drawn(data_dir: Path, needs: Callable[[str], str], tmp_path: Path) -> None:
    drawn = tmp_path / "features.png"
    arguments = ["--data", str(data_dir), "--backend", needs("opencl"), "--figure", str(drawn)]
    subprocess.run([sys.executable, str(BENCH / "accuracy" / "features.py"), *arguments], check=True, timeout=300)
    assert drawn.read_bytes().startswith(b"\x89PNG")
