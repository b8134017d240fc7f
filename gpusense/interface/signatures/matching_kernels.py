"""Kernels that match scans to scans and to maps, find lines and circles in them, and learn parameters."""

from __future__ import annotations

from gpusense.interface.constants import (
    CIRCLE_NUMBERS,
    CLIMB,
    GRADIENT_NUMBERS,
    LINE_NUMBERS,
    MATCH_RESULT,
    MATCH_RULES,
)
from gpusense.interface.signatures.rows import PLACED, WINDOW, Kernel, kernel

# Points of all scans, sorted by bearing in each scan: x, y [m], bearing in [0, 2 pi), range [m].
_POINTS = ("real4 point [points]", "int start [scans + 1]")


def _size(table: str) -> str:
    """Return the number of cells of tables with their margins."""
    return f"{table}.tables * ({table}.rows + 2 * {table}.margin) * ({table}.cols + 2 * {table}.margin)"


# Tables of scores, the losses of quarters of blocks, and the end points of scans that read them.
_CELLS, _QUARTERS = f"uchar table [{_size('scores')}]", f"int quarters [{_size('scores')}]"
_ENDS = ("int2 point [points]", "int image [points]", "int first [items + 1]")
# All lines of shifts of items, lines of an item, shifts of a line, shifts between lines and along them.
_LINES = ("int all", "int lines", "int length", "int spacing", "int along")
_NOISY = (*_POINTS, "real noise [scans]")
# Parts of scans: first point and number of points.
_PARTS = ("int2 part [parts]", "int scan [parts]")
# Readings and expected ranges to learn from, in blocks of equal length, and the mixture.
_PAIRS = (
    "real reading [blocks * readings]",
    "real expected [blocks * readings]",
    "MixtureTerms terms [1]",
    "real masses [1]",
)

KERNELS: dict[str, Kernel] = {
    "field_gradient": kernel(
        "field_gradient", "particle", "real table [(window.rows + 4) * (window.cols + 4)]", *PLACED,
        "real2 point [readings]", "real2 point_low [readings]", "FieldTerms terms [1]",
        "int start [scans + 1] if SCANS", "real constant_terms [scans] if SCANS",
        f"out real gradient [{GRADIENT_NUMBERS} * particles]", WINDOW,
        "int particles", "int readings", "real guard", "real mount_x", "real mount_y", "real resolution",
        "Score score", "ScanBatch batch if SCANS", in_lanes=True,
    ),
    "climb_field": kernel(
        "field_climb", "scan", "real table [(window.rows + 4) * (window.cols + 4)]", "out double poses [3 * scans]",
        f"out double climb [{CLIMB} * scans]", "out int2 pose_cell [scans]", "out real4 pose [scans]",
        "out real4 pose_low [scans]", "out int pose_status [2]", "real2 point [readings]", "real2 point_low [readings]",
        "FieldTerms terms [1]", "int start [scans + 1] if SCANS", "real constant_terms [scans] if SCANS", "int scans",
        "int readings", "real guard", "real mount_x", "real mount_y", "real resolution", "Score score", "int most",
        "double small", "double yaw_cos", "double yaw_sin", "Frame frame", WINDOW, team=256,
    ),
    "fit_lines": kernel(
        "line_fit", "beam scan", *_POINTS, "int which [chosen]", "out real4 line [points]", "int scans", "int points",
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
        "score_tables", "col line image", _CELLS,
        f"out uchar pooled [{_size('scores')}]",
        "ScoreTable scores", "int reach",
    ),
    "fold_scores": kernel(
        "score_tables", "col line image", _CELLS,
        f"out uchar out [{_size('folded')}]",
        "ScoreTable scores", "ScoreTable folded", "int period", "int step", "int beyond", "int unit",
    ),
    "pack_quarters": kernel(
        "score_tables", "col line image", _CELLS, f"out {_QUARTERS}", "ScoreTable scores", "int reach",
    ),
    "fold_quarters": kernel(
        "score_tables", "col line image", _CELLS, f"uchar bound [{_size('bounds')}]",
        f"out int quarters [{_size('folded')}]", "ScoreTable scores", "ScoreTable bounds", "ScoreTable folded",
        "int period", "int step", "int reach", "int beyond", "int unit", "int across",
    ),
    "place_ends": kernel(
        "search_ends", "worker item", "double end [2 * ends]", "double heading [2 * items]", "double start [2 * scans]",
        "int first [items + 1]", "out int image [points]", "out int2 point [points]", "out int2 folded [points]",
        "out int bound_image [points]", "out int quarter_image [points]", "int items", "int turns", "int stride",
        "int level", "int step_level", "int offset", "int workers",
        "int size", "int bound_size", "int quarter_size",
    ),
    "pack_rows": kernel(
        "score_tables", "col line image", _CELLS, f"out int packed [{_size('scores')}]", "ScoreTable scores",
    ),
    "shift_scores": kernel(
        "search", "col rows item", f"int table [{_size('scores')}]", *_ENDS, "uchar allowed [height * width]",
        "out int score [items * height * width]", "ScoreTable scores", "int items", "int height", "int width",
        "int unit",
    ),
    "line_maxima": kernel(
        "search", "line", "int score [all * length]", "out int best [2 * all]", "out int histogram [bins]", *_LINES,
        "int turns", "int shift",
    ),
    "count_promising": kernel(
        "search", "item", "int best [2 * items * lines]", "int histogram [bins]", "out int number [items]",
        "int items", "int lines", "int turns", "int shift", "int most",
    ),
    "pick_blocks": kernel(
        "search", "item", "int best [2 * items * lines]", "int histogram [bins]", "int number [items]",
        "out int block [4 * followed]", "int items", "int lines", "int width", "int turns", "int level", "int shift",
        "int most",
    ),
    "raise_low": kernel(
        "search", "pose", "int block [4 * blocks]", "int slack [scans]", "out int low [scans]", "int blocks",
        "int most",
    ),
    "choose_blocks": kernel(
        "search", "line", "int score [all * length]", "int best [2 * all]", "int low [scans]",
        "out int block [4 * room]", "out int count [levels]", *_LINES, "int width", "int turns", "int level",
        "int room",
    ),
    "follow_blocks": kernel(
        "search", "block", _QUARTERS, *_ENDS, "uchar allowed [rows * columns]", "out int block [4 * blocks]",
        "ScoreTable scores", "int blocks", "int height", "int width", "int columns", "int level", "int spacing",
        "int shift", "int across", team=32,
    ),
    "divide_blocks": kernel(
        "search", "worker", _QUARTERS, *_ENDS, "uchar allowed [rows * columns]", "int block [4 * (begin + some)]",
        "int low [scans]", "out int part [4 * room]", "out int count [levels]", "ScoreTable scores", "int begin",
        "int some", "int room", "int workers", "int run", "int height", "int width", "int columns", "int turns",
        "int level", "int spacing", "int shift", "int across", team=32,
    ),
    "split_scans": kernel(
        "segments", "scan", *_NOISY, "out real cost [points]", "out int stop [points]", "int scans", "int points",
        "real penalty", "real gap", group=16,
    ),
    "fit_segments": kernel(
        "segments", "part", *_NOISY, *_PARTS, f"out real line [{LINE_NUMBERS} * parts]", "int scans", "int points",
        "int parts", group=16,
    ),
    "fit_circles": kernel(
        "circles", "part", *_NOISY, *_PARTS, "real4 edge [parts]", f"out real circle [{CIRCLE_NUMBERS} * parts]",
        "int scans", "int points", "int parts", group=16,
    ),
    "e_step": kernel(
        "learning", "block", *_PAIRS, "out real sums [blocks * width]", "int blocks", "int readings",
        "int across", "int along", "int width",
    ),
    "pair_causes": kernel(
        "learning", "block", *_PAIRS, "out real4 causes [blocks * readings]", "int blocks",
        "int readings", "int across", "int along",
    ),
}  # fmt: skip
