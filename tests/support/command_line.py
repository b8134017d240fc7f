"""The command line for tests: calls in this process and in child processes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import gpusense
from gpusense.commands import cli

SMALL = ["demo", "--particles", "400", "--beams", "20"]


def script(code: str, *, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run Python code that imports the gpusense under test."""
    prologue = f"import sys; sys.path.insert(0, {str(Path(gpusense.__file__).parents[1])!r})\n"
    return subprocess.run([sys.executable, "-c", prologue + code], cwd=cwd, capture_output=True, text=True, check=False)


def error_of(argv: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """Return the only line that a bad call prints, without the program's name."""
    assert cli.main(argv) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("gpusense: error: ") and err.endswith("\n") and err.count("\n") == 1
    return err.removeprefix("gpusense: error: ").removesuffix("\n")
