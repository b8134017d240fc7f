"""Kernels that match scans to scans and to maps, by steps from a guess or by exhaustive search."""

from __future__ import annotations

from gpusense.interface.constants import GRADIENT_NUMBERS, MATCH_RESULT, MATCH_RULES
from gpusense.interface.signatures.rows import PLACED, WINDOW, Kernel, kernel

# Points of all scans, sorted by bearing in each scan: x, y [m], bearing in [0, 2 pi), range [m].
_POINTS = ("real4 point [points]", "int start [scans + 1]")
_CELLS = "uchar table [scores.tables * (scores.rows + 2 * scores.margin) * (scores.cols + 2 * scores.margin)]"
_CELL_POINTS = ("int2 point [points]", "int image [points]", "int first [items + 1]")

KERNELS: dict[str, Kernel] = {
    "field_gradient": kernel(
        "field_gradient", "particle", "real table [(window.rows + 4) * (window.cols + 4)]", *PLACED,
        "real2 point [readings]", "real2 point_low [readings]", "real terms [8]", "int start [scans + 1]",
        "real constant_terms [scans]", f"out real gradient [{GRADIENT_NUMBERS} * particles]", WINDOW,
        "int particles", "int readings", "real guard", "real mount_x", "real mount_y", "real resolution",
        "Score score", "ScanBatch batch", in_lanes=True,
    ),
    "fit_lines": kernel(
        "lines", "beam scan", *_POINTS, "int which [chosen]", "out real4 line [points]", "int scans", "int points",
        "int chosen", "int reach", "int most", "real ratio", "real slack", "real width", "real gap", in_lanes=True,
        lanes_group=8,
    ),
    "place_pair": kernel(
        "scan_pair", "item", "double reading [2 * beams]", "double beam [4 * beams]", "double weight [2 * padded]",
        "double level [2 * levels]", "out double work [4 * padded]", "out real4 point [2 * beams]",
        "out real4 line [2 * beams]", "out int start [3]", "out int pair [3]", "out double summary [5]", "int beams",
        "int places", "int padded", "int step", "double nearest", "double farthest", "int levels", "int assumed",
        "int coarse", "int strides", "int reach", "int most", "real ratio", "real width", "real gap", group=1,
    ),
    "match_scans": kernel(
        "icp", "item", *_POINTS, "real4 line [points]", "int pair [3 * pairs]", "real4 guess [pairs * starts]",
        f"real rules [{MATCH_RULES} * levels]", f"out real result [{MATCH_RESULT} * turns * pairs * starts]",
        "int scans", "int points", "int pairs", "int starts", "int levels", "int turns", "real far", "real far_turn",
        group=4, team=256,
    ),
    "pool_scores": kernel(
        "search", "col line image", _CELLS,
        "out uchar pooled [scores.tables * (scores.rows + 2 * scores.margin) * (scores.cols + 2 * scores.margin)]",
        "ScoreTable scores", "int reach",
    ),
    "fold_scores": kernel(
        "search", "col line image", _CELLS,
        "out uchar out [folded.tables * (folded.rows + 2 * folded.margin) * (folded.cols + 2 * folded.margin)]",
        "ScoreTable scores", "ScoreTable folded", "int period", "int beyond",
    ),
    "shift_scores": kernel(
        "search", "col row item", _CELLS, *_CELL_POINTS, "out int score [items * height * width]", "ScoreTable scores",
        "int items", "int height", "int width", in_lanes=True,
    ),
    "candidate_scores": kernel(
        "search", "candidate", _CELLS, *_CELL_POINTS, "int candidate [3 * candidates]", "out int score [candidates]",
        "ScoreTable scores", "int candidates",
    ),
}  # fmt: skip
