"""bench/speed/history.py appends rows, and detects a regression of 10 % in quiet runs."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
from support.paths import ROOT

SCRIPT = ROOT / "bench" / "speed" / "history.py"


@pytest.fixture
def history(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "bench"))
    return importlib.import_module("speed.history")


def row(commit: str, ms: float, *, probe: float = 2.0, error: float = 1e-5, quiet: str = "yes", device: str = "X"):
    values = ("2026-01-01", commit, device, "rays, 10 x 10", ms, ms, ms, probe, error, "nats", quiet)
    names = ("date", "commit", "device", "row", "ms", "q1_ms", "q3_ms", "probe_ms", "error", "unit", "quiet")
    return {name: str(value) for name, value in zip(names, values, strict=True)}


BEFORE = [row("a", 10.0), row("b", 10.3), row("c", 9.8)]


@pytest.mark.parametrize(
    ("last", "seen"),
    [
        (row("d", 10.9), ""),
        (row("d", 11.2), "1.12 times the time of 3 quiet runs"),
        # The processor itself is slower by a fifth today, which the probe shows.
        (row("d", 12.0, probe=2.4), ""),
        (row("d", 13.4, probe=2.4), "1.12 times"),
        # Times of a busy machine do not count, but errors do.
        (row("d", 30.0, quiet="no"), ""),
        (row("d", 30.0, quiet="no", error=0.1), "error 0.1 nats, before 1e-05"),
        (row("d", 10.0, error=9e-4), ""),
        # A repeated commit and another device have no row to compare with.
        (row("c", 99.0), "9.75 times the time of 2 quiet runs"),
        (row("d", 99.0, device="Y"), ""),
    ],
)
def test_a_regression_of_a_tenth_is_seen(history: ModuleType, last: dict[str, str], seen: str) -> None:
    found = history.regressions([*BEFORE, last])
    assert len(found) == bool(seen) and all(seen in line for line in found)


def test_the_probe_counts_for_processors_alone(history: ModuleType) -> None:
    rows = [row(name, 10.0, device="NVIDIA X, warp") for name in "ab"]
    assert history.regressions([*rows, row("c", 12.0, probe=2.4, device="NVIDIA X, warp")])


def test_rows_are_appended_and_compared(
    history: ModuleType, needs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "history.csv"
    words = ["--backend", needs("numpy"), "--size", "40", "8", "--turns", "3", "--tries", "1", "--file", str(table)]

    def run(*more: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run([sys.executable, str(SCRIPT), *words, *more], capture_output=True, text=True, check=False)

    monkeypatch.setattr(sys, "argv", [str(SCRIPT), *words, "--commit", "a", "--limit", "1e9"])
    assert history.main() == 0 and capsys.readouterr().out == "no regression\n"
    done = run("--commit", "b", "--limit", "1e9")
    assert (done.returncode, done.stdout) == (0, "no regression\n"), done.stderr
    lines = table.read_text().splitlines()
    assert len(lines) == 7 and lines[0].startswith("date,commit,device,row,ms,")
    assert [line.split(",")[1] for line in lines[1:]] == ["a"] * 3 + ["b"] * 3
    table.write_text("x,y\n1,2\n")
    monkeypatch.setattr(sys, "argv", [str(SCRIPT), *words, "--compare"])
    with pytest.raises(SystemExit, match=r"^2$"):
        history.main()
    assert "history.csv: must have the columns date, commit" in capsys.readouterr().err


def test_the_table_of_the_project_is_whole(history: ModuleType) -> None:
    rows = history.read(history.FILE)
    assert rows and {row["unit"] for row in rows} <= set(history.FLOORS)
    assert all(float(row["ms"]) > 0 and row["quiet"] in ("yes", "no") for row in rows)
