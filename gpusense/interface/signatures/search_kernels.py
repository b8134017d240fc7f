"""Kernels of exhaustive search over poses."""

from __future__ import annotations

from gpusense.interface.signatures.rows import Kernel, kernel

_CELLS = "uchar table [scores.tables * (scores.rows + 2 * scores.margin) * (scores.cols + 2 * scores.margin)]"
_POINTS = ("int2 point [points]", "int image [points]", "int first [items + 1]")

KERNELS: dict[str, Kernel] = {
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
        "search", "col row item", _CELLS, *_POINTS, "out int score [items * height * width]", "ScoreTable scores",
        "int items", "int height", "int width", in_lanes=True,
    ),
    "candidate_scores": kernel(
        "search", "candidate", _CELLS, *_POINTS, "int candidate [3 * candidates]", "out int score [candidates]",
        "ScoreTable scores", "int candidates",
    ),
}  # fmt: skip
