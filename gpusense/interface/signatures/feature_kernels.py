"""Kernels that find straight segments and circles in scans."""

from __future__ import annotations

from gpusense.interface.constants import CIRCLE_NUMBERS, LINE_NUMBERS
from gpusense.interface.signatures.rows import Kernel, kernel

# Points of all scans, sorted by bearing in each scan: x, y [m], bearing in [0, 2 pi), range [m]; noise of each scan.
_POINTS = ("real4 point [points]", "int start [scans + 1]", "real noise [scans]")
# Parts of scans: first point and number of points.
_PARTS = ("int2 part [parts]", "int scan [parts]")

KERNELS: dict[str, Kernel] = {
    "split_scans": kernel(
        "segments", "scan", *_POINTS, "out real cost [points]", "out int stop [points]", "int scans", "int points",
        "real penalty", "real gap", group=16,
    ),
    "fit_segments": kernel(
        "segments", "part", *_POINTS, *_PARTS, f"out real line [{LINE_NUMBERS} * parts]", "int scans", "int points",
        "int parts", group=16,
    ),
    "fit_circles": kernel(
        "circles", "part", *_POINTS, *_PARTS, "real4 edge [parts]", f"out real circle [{CIRCLE_NUMBERS} * parts]",
        "int scans", "int points", "int parts", group=16,
    ),
}  # fmt: skip
