"""Kernels that match scans."""

from __future__ import annotations

from gpusense.interface.constants import MATCH_RESULT
from gpusense.interface.signatures.rows import Kernel, kernel

# Points of all scans, sorted by bearing in each scan: x, y [m], bearing in [0, 2 pi), range [m].
_POINTS = ("real4 point [points]", "int start [scans + 1]")

KERNELS: dict[str, Kernel] = {
    "fit_lines": kernel(
        "icp", "beam scan", *_POINTS, "out real4 line [points]", "int scans", "int points", "int reach", "int most",
        "real ratio", "real slack", "real width",
    ),
    "match_scans": kernel(
        "icp", "item", *_POINTS, "real4 line [points]", "int2 pair [pairs]", "real4 guess [pairs * starts]",
        f"out real result [{MATCH_RESULT} * pairs * starts]", "int scans", "int points", "int pairs", "int starts",
        "MatchRules rules", group=4,
    ),
}  # fmt: skip
