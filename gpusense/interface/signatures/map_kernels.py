"""Kernels that make tables of a map, build maps from scans, and compare scans with maps."""

from __future__ import annotations

from gpusense.interface.signatures.rows import WINDOW, Kernel, kernel

_MAP = ("int rows", "int cols")
_PLANES = "ushort rectangles [4 * sectors * (rows + 2) * (cols + 2)]"
_CHANGED = (
    *_MAP, "int sectors", "int first", "int band", "int top", "int left", "int bottom", "int right", "int worlds",
)  # fmt: skip

KERNELS: dict[str, Kernel] = {
    "distance_lines": kernel(
        "distance", "line", "uchar occupied [rows * cols]", "out int along [rows * cols]",
        "int lines", "int length", "int line_stride", "int step", group=16,
    ),
    "distance_envelope": kernel(
        "distance", "line", "int along [rows * cols]", "out int starts [rows * cols]", "out int squared [rows * cols]",
        "int lines", "int length", "int line_stride", "int step", group=16,
    ),
    "distance_bits": kernel(
        "distance", "col row", "int bits [rows * words]", "out ushort nearest [rows * cols]", *_MAP, "int words",
        "int reach",
    ),
    "distance_blocks": kernel(
        "distance", "col block", "ushort nearest [rows * cols]", "out ushort blocks [count * cols]", *_MAP, "int count",
    ),
    "distance_search": kernel(
        "distance", "col row", "ushort nearest [rows * cols]", "ushort blocks [count * cols]",
        "out int squared [rows * cols]", *_MAP, "int count", "int most",
    ),
    "free_columns": kernel(
        "rectangles", "strip direction", "uchar occupied [band * cols]", "out uchar runs [2 * band * cols]",
        "int band", "int cols", "int begin", "int end", group=1,
    ),
    "rectangles_rows": kernel(
        "rectangles", "row quadrant", "uchar runs [2 * band * cols * worlds]", "int place [worlds]",
        "out int stack [1024 * rows * worlds]", f"out {_PLANES}", *_CHANGED, group=1,
    ),
    "free_rows": kernel(
        "rectangles", "col row", "int bits [band * words]", "out uchar runs [2 * band * cols]", "int band", "int cols",
        "int words", "int begin", "int end",
    ),
    "rectangles_scan": kernel(
        "rectangles", "col tile quadrant", "uchar runs [2 * band * cols * worlds]", "int place [worlds]",
        "out ushort rectangles [4 * sectors * lines * (cols + 2)]", *_CHANGED, "int lines", "int group",
    ),
    "fill_lookup": kernel(
        "lookup_table", "bin cell", "ushort rectangles [map]", "real2 ray [bins]",
        "out ushort lookup [window.rows * window.cols * bins]", WINDOW, "int bins", "int first_row", "int count",
        "real limit",
    ),
    "fill_field": kernel(
        "distance", "col row", "int squared [rows * cols]", "real density [cap + 1]",
        "out real table [begin + height * stride]", *_MAP, "int cap", "real beyond", "int from_col", "int from_row",
        "int width", "int height", "int begin", "int stride",
    ),
    "count_rays": kernel(
        "ray_counts", "ray", "int2 start_cell [rays]", "int2 start_inside [rays]", "int2 end_cell [rays]",
        "int2 end_inside [rays]", "int hit [rays]", "out int hits [rows * cols]", "out int misses [rows * cols]",
        *_MAP, "int rays",
    ),
    "judge_beams": kernel(
        "beam_consistency", "beam", "uchar cells [rows * cols]", "double estimate [9]", "double scan [2 * beams]",
        "out double judged [2 * beams]", "Frame frame", "BeamRules rules", *_MAP, "int beams", group=4, team=256,
    ),
}  # fmt: skip
