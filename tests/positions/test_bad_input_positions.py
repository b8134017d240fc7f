"""Bad input to position functions is refused with the exact message."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

import gpusense as gs

Action = Callable[[], object]
XY = [(0.0, 0.0), (4.0, 0.0), (0.0, 4.0)]
NAN = float("nan")


def ranges(xy: Any = XY, values: Any = (1.0, 2.0, 3.0), **options: Any) -> Action:
    """Trilaterate with bad arguments."""
    return lambda: gs.trilaterate(xy, values, **options)


def bearings(xy: Any = XY, values: Any = (0.1, 0.2, 0.3), **options: Any) -> Action:
    """Triangulate with bad arguments."""
    return lambda: gs.triangulate(xy, values, **options)


def triangle(xy: Any = XY, values: Any = (0.1, 0.2, 0.3), **options: Any) -> Action:
    """Triangulate three bearings with bad arguments."""
    return lambda: gs.triangulate_triangle(xy, values, **options)


def both(xy: Any = XY, r: Any = (1.0, 2.0, 3.0), b: Any = (0.1, 0.2, 0.3), **options: Any) -> Action:
    """Locate from both with bad arguments."""
    return lambda: gs.locate(xy, r, b, **{"sigma_range": 0.1, "sigma_bearing": 0.1, **options})


CIRCLE = ", or a circle of solutions remains"
ARC, RAY = ", or an arc of solutions remains", ", or a ray of solutions remains"
LOSSES = "'linear', 'soft_l1', 'huber', 'cauchy', 'arctan'"
V, T = ValueError, TypeError
CASES: list[tuple[Action, type[Exception], str]] = [
    (ranges(XY[:1], [1.0]), V, f"xy: must hold at least 2 beacons{CIRCLE}, got 1"),
    (ranges([(0.0, 0.0)][:0], []), V, "xy: shape must be (M, 2), got (0,)"),
    (ranges([(0, 0), (0, NAN), (1, 1)]), V, "xy: every value must be finite, got nan at index (1, 1)"),
    (ranges(values=[1, -2, 1]), V, "ranges: must be >= 0, got -2.0 at index 1"),
    (bearings(XY[:2], [0, 1]), V, f"xy: must hold at least 3 beacons{ARC}, got 2"),
    (bearings(XY[:1], [0], heading=0.0), V, f"xy: must hold at least 2 beacons{RAY}, got 1"),
    (bearings(weights=[1, 0, 1]), V, f"weights: must be > 0 for at least 3 beacons{ARC}, got 2"),
    (both(XY[:1], [1], [0]), V, f"xy: must hold at least 2 beacons{CIRCLE}, got 1"),
    (both([(0.0, 0.0)], [1], [0], heading=0, weights=[0]), V, "weights: must be > 0 for at least 1 beacon, got 0"),
    (ranges(loss="l2"), V, f"loss: must be one of {LOSSES}, got 'l2'"),
    (ranges(loss_scale=0), V, "loss_scale: must be finite and > 0, got 0"),
    (triangle(XY[:2], [0, 1]), V, "xy: must hold exactly 3 beacons, got 2"),
    (triangle(XY + XY[:1], [0, 1, 2, 3]), V, "xy: must hold exactly 3 beacons, got 4"),
]  # fmt: skip


@pytest.mark.parametrize(("action", "kind", "message"), CASES)
def test_bad_input(action, kind, message):
    with pytest.raises(kind) as caught:
        action()
    assert type(caught.value) is kind
    assert str(caught.value) == message
