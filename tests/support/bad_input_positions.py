"""Bad input to the position functions, with the exact messages: (id, action, exception type, message)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

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
CASES: list[tuple[str, Action, type[Exception], str]] = [
    ("one-circle", ranges(XY[:1], [1.0]), V, f"xy: must hold at least 2 beacons{CIRCLE}, got 1"),
    ("no-beacon", ranges([(0.0, 0.0)][:0], []), V, "xy: shape must be (M, 2), got (0,)"),
    ("xy-flat", ranges([1.0, 2.0]), V, "xy: shape must be (M, 2), got (2,)"),
    ("xy-3d", ranges([(1.0, 2.0, 3.0)] * 2), V, "xy: shape must be (M, 2), got (2, 3)"),
    ("xy-words", ranges([("a", "b")]), T, "xy: must hold real numbers, got dtype <U1"),
    ("xy-none", ranges(None), T, "xy: must hold real numbers, got dtype object"),
    ("xy-ragged", ranges([(1.0,), (1.0, 2.0)]), V, "xy: must be an array of one shape, got [(1.0,), (1.0, 2.0)]"),
    ("xy-nan", ranges([(0, 0), (0, NAN), (1, 1)]), V, "xy: every value must be finite, got nan at index (1, 1)"),
    ("ranges-short", ranges(values=[1.0]), V, "ranges: shape must be (3,), got (1,)"),
    ("ranges-nan", ranges(values=[1, NAN, 1]), V, "ranges: every value must be finite, got nan at index 1"),
    ("ranges-inf", ranges(values=[1, 2, float("inf")]), V, "ranges: every value must be finite, got inf at index 2"),
    ("ranges-negative", ranges(values=[1, -2, 1]), V, "ranges: must be >= 0, got -2.0 at index 1"),
    ("ranges-bool", ranges(values=[True] * 3), T, "ranges: must hold real numbers, got dtype bool"),
    ("sigma-0", ranges(sigma=0), V, "sigma: must be > 0, got 0.0"),
    ("sigma-negative", ranges(sigma=[1, -1, 1]), V, "sigma: must be > 0, got -1.0"),
    ("sigma-nan", ranges(sigma=NAN), V, "sigma: every value must be finite, got nan"),
    ("sigma-shape", ranges(sigma=[1.0, 1.0]), V, "sigma: shape must be () or (3,), got (2,)"),
    ("sigma-word", ranges(sigma="small"), T, "sigma: must hold real numbers, got dtype <U5"),
    ("weights-shape", ranges(weights=1.0), V, "weights: shape must be (3,), got ()"),
    ("weights-negative", ranges(weights=[1, 1, -0.5]), V, "weights: must be >= 0, got -0.5 at index 2"),
    ("weights-0", ranges(weights=[0, 1, 0]), V, f"weights: must be > 0 for at least 2 beacons{CIRCLE}, got 1"),
    ("loss", ranges(loss="l2"), V, f"loss: must be one of {LOSSES}, got 'l2'"),
    ("loss-none", ranges(loss=None), T, f"loss: must be one of {LOSSES}, got None"),
    ("loss-scale", ranges(loss_scale=0), V, "loss_scale: must be finite and > 0, got 0"),
    ("bearings-two", bearings(XY[:2], [0, 1]), V, f"xy: must hold at least 3 beacons{ARC}, got 2"),
    ("bearings-one", bearings(XY[:1], [0], heading=0.0), V, f"xy: must hold at least 2 beacons{RAY}, got 1"),
    ("bearings-nan", bearings(values=[0, 0, NAN]), V, "bearings: every value must be finite, got nan at index 2"),
    ("bearings-shape", bearings(values=[[0.0]] * 3), V, "bearings: shape must be (3,), got (3, 1)"),
    ("bearings-complex", bearings(values=[1j] * 3), T, "bearings: must hold real numbers, got dtype complex128"),
    ("heading-nan", bearings(heading=NAN), V, "heading: must be finite, got nan"),
    ("heading-word", bearings(heading="north"), T, "heading: must be a real number, got 'north'"),
    ("heading-array", bearings(heading=[0.0]), T, "heading: must be a real number, got [0.0]"),
    ("bearings-weights", bearings(weights=[1, 0, 1]), V, f"weights: must be > 0 for at least 3 beacons{ARC}, got 2"),
    ("bearings-sigma", bearings(sigma=-1), V, "sigma: must be > 0, got -1.0"),
    ("triangle-two", triangle(XY[:2], [0, 1]), V, "xy: must hold exactly 3 beacons, got 2"),
    ("triangle-four", triangle(XY + XY[:1], [0, 1, 2, 3]), V, "xy: must hold exactly 3 beacons, got 4"),
    ("triangle-shape", triangle(values=[0, 1]), V, "bearings: shape must be (3,), got (2,)"),
    ("triangle-sigma", triangle(sigma=[1, 1]), V, "sigma: shape must be () or (3,), got (2,)"),
    ("both-one", both(XY[:1], [1], [0]), V, f"xy: must hold at least 2 beacons{CIRCLE}, got 1"),
    ("both-none", both([(0.0, 0.0)], [1], [0], heading=0, weights=[0]), V,
     "weights: must be > 0 for at least 1 beacon, got 0"),
    ("both-ranges", both(r=[1.0]), V, "ranges: shape must be (3,), got (1,)"),
    ("both-bearings", both(b=[1.0]), V, "bearings: shape must be (3,), got (1,)"),
    ("both-sigma-range", both(sigma_range=0), V, "sigma_range: must be > 0, got 0.0"),
    ("both-sigma-bearing", both(sigma_bearing=[1]), V, "sigma_bearing: shape must be () or (3,), got (1,)"),
    ("both-sigma-none", both(sigma_range=None), T, "sigma_range: must hold real numbers, got None"),
]  # fmt: skip
