"""Run a script of bench/ (not in the wheel)."""

from __future__ import annotations

import contextlib
import io
import json
import runpy
import subprocess
import sys
import warnings
from pathlib import Path
from unittest import mock

from support.paths import ROOT

BENCH = ROOT / "bench"


def run_script(name: str, *arguments: str, output: Path) -> dict:
    """Run a script as a program, check its Markdown, and return its report."""
    command = [sys.executable, str(BENCH / name), *arguments, "--output", str(output)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr[-3000:]
    return report_of(name, output, done.stdout)


def run_here(name: str, *arguments: str, output: Path) -> dict:
    """Run a script like :func:`run_script`, but in this process with its started devices and compiled kernels."""
    command = [str(BENCH / name), *arguments, "--output", str(output)]
    with (
        mock.patch.object(sys, "argv", command),
        mock.patch.object(sys, "path", list(sys.path)),
        warnings.catch_warnings(),
        contextlib.redirect_stdout(io.StringIO()) as printed,
    ):
        warnings.simplefilter("ignore")
        try:
            runpy.run_path(command[0], run_name="__main__")
        except SystemExit as end:
            assert not end.code, end.code
    return report_of(name, output, printed.getvalue())


def report_of(name: str, output: Path, printed: str) -> dict:
    """Check that a script printed its Markdown, and return its report."""
    assert output.with_suffix(".md").read_text() == printed.removesuffix("\n")

    def refuse(word: str) -> float:
        raise ValueError(f"{word} is no JSON")

    report = json.loads(output.with_suffix(".json").read_text(), parse_constant=refuse)
    assert report["command"].startswith(f"python bench/{name} ")
    assert str(output.parent) not in json.dumps(report)
    return report
