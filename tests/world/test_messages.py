"""Scanners and maps from any object or mapping with the fields of ROS messages."""

from __future__ import annotations

import array
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import gpusense as gs


def laser(**changes: Any) -> dict[str, Any]:
    return dict(angle_min=-1.5, angle_max=1.5, angle_increment=0.5, range_min=0.1, range_max=8.0,
                ranges=[1.0] * 7) | changes  # fmt: skip


def grid(data: Any = (0, 100, -1, 50, 0, 0), yaw: float = 0.5, **changes: Any) -> dict[str, Any]:
    turn = dict(x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2))
    pose = dict(position=dict(x=1.0, y=-2.0, z=0.3), orientation=turn)
    return dict(info=dict(resolution=0.1, width=3, height=2, origin=pose) | changes, data=data)


def as_object(value: Any) -> Any:
    if isinstance(value, dict):
        return SimpleNamespace(**{key: as_object(each) for key, each in value.items()})
    return value


@pytest.mark.parametrize("form", [dict, as_object])
def test_a_scanner(form: Any) -> None:
    for ranges in ([1.0] * 7, array.array("f", [1.0] * 7), np.ones(7, np.float32)):
        scanner = gs.Scanner.from_laser_scan(form(laser(ranges=ranges)), mount=(0.1, 0.2, 0.3))
        same = gs.Scanner.uniform(angle_min=-1.5, angle_increment=0.5, count=7, range_min=0.1, range_max=8.0,
                                  mount=(0.1, 0.2, 0.3))  # fmt: skip
        assert scanner == same
    assert gs.Scanner.from_laser_scan(form(laser(angle_increment=-0.5))).bearings[1] == -2.0


def test_arguments_replace_limits_of_ranges_before_these_are_checked() -> None:
    for bad in (math.inf, math.nan, 0.0, -1.0, float(np.finfo(np.float32).max)):
        assert gs.Scanner.from_laser_scan(laser(range_max=bad), range_max=8.0).range_max == 8.0
    for bad in (math.inf, math.nan, -1.0, 9.0):
        assert gs.Scanner.from_laser_scan(laser(range_min=bad), range_min=0.1).range_min == 0.1
    with pytest.raises(ValueError, match=r"^range_max: must be finite and > 0, got inf$"):
        gs.Scanner.from_laser_scan(laser(), range_max=math.inf)


@pytest.mark.parametrize("form", [dict, as_object])
def test_a_map(form: Any) -> None:
    rows = [[0, 100, -1], [50, 0, 0]]
    flat = [0, 100, -1, 50, 0, 0]
    for data in (flat, array.array("b", flat), np.array(flat, np.int8), np.array(flat, np.int8).tobytes()):
        found = gs.OccupancyGrid.from_message(form(grid(data)), occupied_threshold=50)
        assert found.cells.tolist() == rows and found.resolution == 0.1 and found.occupied_threshold == 50
        np.testing.assert_allclose(found.origin, (1.0, -2.0, 0.5), rtol=1e-12)


V, T = ValueError, TypeError
CASES: list[tuple[Any, dict[str, Any], type[Exception], str]] = [
    ("scan", {"range_max": 8.0}, T, "message: must have the field angle_min, got {'range_max': 8.0}"),
    ("scan", laser(angle_min="a"), T, "message.angle_min: must be a real number, got 'a'"),
    ("scan", laser(range_max=math.inf), V,
     "message.range_max: must be finite and > 0, got inf; range_max= replaces it"),
    ("scan", laser(range_max=0.0), V, "message.range_max: must be finite and > 0, got 0.0; range_max= replaces it"),
    ("scan", laser(range_min=math.nan), V,
     "message.range_min: must be finite and >= 0, got nan; range_min= replaces it"),
    ("scan", laser(angle_increment=0.0), V, "message.angle_increment: must not be 0 for 7 beams, got 0"),
    ("scan", laser(ranges=[[1.0]]), V, "message.ranges: shape must be (K,), got (1, 1)"),
    ("grid", grid([0, 0]), V, "message.data: must hold width * height = 6 cells, got 2"),
    ("grid", grid(width=1e9), T, "message.info.width: must be an integer, got 1000000000.0"),
    ("grid", grid(width=2**31, height=2**31), V, f"message.data: must hold width * height = {2**62} cells, got 6"),
    ("grid", grid([0, 0, 0, 0, 0, 101]), V, "cells: every value must be from -1 to 100, got 101 at index (1, 2)"),
    ("grid", grid(origin=dict(position=dict(x=0.0, y=0.0), orientation=dict(x=1.0, y=0.0, z=0.0, w=1.0))), V,
     "message.info.origin.orientation: must be level, with a rotation about z only, got a tilt of 90 deg"),
    ("grid", grid(origin=dict(position=dict(x=0.0, y=0.0), orientation=dict(x=0.0, y=0.0, z=0.0, w=0.0))), V,
     "message.info.origin.orientation: must be a rotation, got the quaternion (0, 0, 0, 0)"),
]  # fmt: skip


@pytest.mark.parametrize("kind, message, error, text", CASES)
def test_bad_messages(kind: str, message: Any, error: type[Exception], text: str) -> None:
    make = gs.Scanner.from_laser_scan if kind == "scan" else gs.OccupancyGrid.from_message
    with pytest.raises(error) as raised:
        make(message)
    assert str(raised.value) == text
