"""Run a script of bench/, which is no part of the wheel."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import mpmath as mp
from support.paths import ROOT

BENCH = ROOT / "bench"


def run_script(name: str, *arguments: str, output: Path) -> dict:
    """Run a script, check its Markdown, and return its report."""
    command = [sys.executable, str(BENCH / name), *arguments, "--output", str(output)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr[-3000:]
    assert output.with_suffix(".md").read_text() == done.stdout.removesuffix("\n")

    def refuse(word: str) -> float:
        raise ValueError(f"{word} is no JSON")

    report = json.loads(output.with_suffix(".json").read_text(), parse_constant=refuse)
    assert report["command"].startswith(f"python bench/{name} ")
    assert str(output.parent) not in json.dumps(report)
    return report


def derived(name: str) -> ModuleType:
    """Import a script of bench/derive, and restore mpmath's precision."""
    spec = importlib.util.spec_from_file_location(name, BENCH / "derive" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    digits = mp.mp.dps
    try:
        spec.loader.exec_module(module)
    finally:
        mp.mp.dps = digits
    return module
