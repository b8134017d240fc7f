"""Durations of scans by the time increments of a bag's messages."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.bags import Writer

import gpusense as gs


@pytest.mark.parametrize(
    ("increment", "expected"), [(0.001, 0.179), (0.0, 0.0), (-0.001, 0.0), (1.0, 0.0), (float("nan"), 0.0)]
)
def test_only_plausible_increments_count(tmp_path: Path, increment: float, expected: float) -> None:
    with Writer(tmp_path, "mcap") as bag:
        bag.scan(1.0, [1.0] * 180, -1.5, 0.01, time_increment=increment)
    (scan,) = gs.read_log(bag.path, mount=(0, 0, 0))
    assert scan.duration == pytest.approx(expected)


@pytest.mark.long
def test_a_recorded_laser_takes_an_eighth_of_a_second(data_dir: Path) -> None:
    bag = data_dir / "jarvis_lab/jarvis_complex_path_fast.bag"
    for topic, expected in (("navigation", 0.125), ("security", 0.0)):
        scan = next(iter(gs.read_log(bag, topic=f"/driver_laser_{topic}/laser_scan")))
        assert scan.duration == pytest.approx(expected, abs=1e-3)
