"""Benchmark scripts on a device that counts as a GPU; bench/ is no part of the wheel."""

from __future__ import annotations

import dataclasses
import importlib
import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from support.paths import ROOT

from gpusense.backends import get_backend

pytestmark = pytest.mark.long

BENCH = ROOT / "bench"


def test_limits_measures_small_calls_on_a_gpu(
    needs: Callable[[str], str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """PoCL's processor replaces a GPU; poses and results are arrays of pyopencl."""
    monkeypatch.syspath_prepend(str(BENCH))
    limits = importlib.import_module("speed.limits")
    device = get_backend(needs("opencl"))
    monkeypatch.setattr(device, "info", dataclasses.replace(device.info, kind="gpu", lanes=1))
    output = tmp_path / "limits"
    arguments = ["--rows", "small", "--repeats", "1", "--seconds", "0.01", "--size", "20", "--output", str(output)]
    monkeypatch.setattr(sys, "argv", ["limits.py", "--backend", "opencl", *arguments])
    assert limits.main() == 0
    rows = json.loads(output.with_suffix(".json").read_text())["rows"]
    names = {row["what"] for row in rows if row["call_s"] > 0 and row["launches"]}
    for model in ("field", "beam model"):
        for count in (2000, 4000):
            assert f"{model}, tracking, {count} x 60, poses and result on the device" in names
