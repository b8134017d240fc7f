"""The script that measures rates over sizes, and the floors that it derives."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
from support.bench_scripts import BENCH, run_script

pytestmark = pytest.mark.long


@pytest.fixture
def scaling(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Import the script as a module."""
    monkeypatch.syspath_prepend(str(BENCH))
    return importlib.import_module("speed.scaling")


SMALL = [
    "--quick", "--particles", "100,300", "--beams", "1,12", "--sides", "100,220", "--particle-beams", "12",
    "--beam-particles", "60", "--map-particles", "60", "--map-beams", "12", "--side", "220", "--seconds", "0.02",
    "--repeats", "2", "--total", "200",
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("selection", ["opencl"])
def test_scaling_runs(selection: str, needs: Callable[[str], str], tmp_path: Path) -> None:
    report = run_script("speed/scaling.py", "--backend", needs(selection), *SMALL, output=tmp_path / "small")
    (device,) = report["devices"]
    rows = device["rows"]
    assert {(row["axis"], row["value"]) for row in rows} == {
        ("particles", 100), ("particles", 300), ("beams", 1), ("beams", 12), ("side", 100), ("side", 220),
    }  # fmt: skip
    assert len(rows) == 18 and device["left_out"] == []
    for row in rows:
        for name in ("floor_call_s", "floor_launch_s", "scattered_s", "call_s", "launch_s", "median_s"):
            assert 0 < row[name] < math.inf, (name, row)
        assert row["floor_launch_s"] <= row["floor_call_s"] and row["floor_launch_s"] <= row["scattered_s"]
        # A floor so far above a measured time would be wrong.
        assert row["floor_launch_s"] < 20 * row["launch_s"], row
        assert row["launches"] >= 1 and row["table_bytes"] > 0 and row["steps"] > 0.5 and row["reads"] >= row["steps"]
        assert row["error"] < 1e-2, row
    (drawn,) = tmp_path.glob("*.png")
    assert drawn.stat().st_size > 10_000


@pytest.mark.slow
def test_sizes_that_do_not_fit_are_listed(needs: Callable[[str], str], tmp_path: Path) -> None:
    arguments = [*SMALL, "--particles", "100,100000000", "--longest", "1e-9"]
    report = run_script("speed/scaling.py", "--backend", needs("opencl"), *arguments, output=tmp_path / "none")
    (device,) = report["devices"]
    assert len(device["rows"]) + len(device["left_out"]) == 18
    assert any("more than the" in line for line in device["left_out"])
    text = (tmp_path / "none.md").read_text()
    assert all(f"- {line}" in text for line in device["left_out"])


def test_floors_are_the_largest_term(scaling: ModuleType) -> None:
    figures = scaling.Figures(
        source="", launch_s=2.0, round_trip_s=5.0, issue=100.0, scattered={4: 8.0, 400: 4.0}, together=10.0,
        copy={4: 50.0}, upload=1e3, download=1e3,
    )  # fmt: skip

    def floor(kind: str, **changes: float) -> tuple[float, str]:
        made = scaling.floor_of(kind, 1, 100, 2, 400, (4.0, 3.0), scaling.dataclasses.replace(figures, **changes))
        return made.launches, made.cause

    assert floor("field") == (17.6, "operations")
    assert floor("field", issue=1e9) == (10.0, "look-ups")
    assert floor("field", issue=1e9, together=1e9) == (5.0, "launches")
    assert floor("field", issue=1e9, together=1e9, round_trip_s=1.0) == (4.0, "launches")
    assert floor("rays", issue=1e9) == (40.0, "look-ups")
    assert floor("rays", issue=1e9, together=1e9) == ((24 + 400) / 50, "bytes")
    assert floor("rays") == ((60 + 100 * (46 + 3 * 41)) / 100, "operations")
    assert floor("beam model") == ((60 + 100 * (46 + 3 * 41 + 42)) / 100, "operations")
    assert floor("rays", upload=0.1) == ((60 + 100 * (46 + 3 * 41)) / 100, "transfer")
    made = scaling.floor_of("field", 1, 100, 2, 400, (4.0, 3.0), figures)
    assert made.scattered == 100 / 4


def test_rates_are_never_too_low(scaling: ModuleType) -> None:
    rates = {16: 9.0, 64: 5.0, 256: 6.0}
    assert [scaling.rate(rates, size) for size in (1, 16, 63, 64, 255, 256, 10**9)] == [
        9.0,
        9.0,
        9.0,
        6.0,
        6.0,
        6.0,
        6.0,
    ]
