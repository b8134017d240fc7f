"""One row per kernel: its file, launch shape and arguments in order. Every backend binds its arguments from here.

A kernel has three bodies (NumPy reference, OpenCL, Warp) with the same name and the same arguments; a test holds the
three to this table. ``real`` stands for the precision of a model, float32 or float64; ``double`` is always float64, and
``coordinate`` (poses) and ``measured`` (readings) are float64, or float32 with POSES_FLOAT32 and RANGES_FLOAT32.
"""

from __future__ import annotations

import ast
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gpusense.interface import casters
from gpusense.interface.constants import MIXTURE_TERMS
from gpusense.interface.structs import STRUCTS

FLAGS = {
    "FLOAT64": "real numbers are float64",
    "ORIGINS_OUTSIDE": "some beam starts outside the grid",
    "OUTSIDE_OCCUPIED": "what lies outside the grid is a wall",
    "HIT": "z_hit > 0",
    "SHORT": "z_short > 0",
    "RAND": "z_rand > 0",
    "BIAS": "range_bias is not 0",
    "GROWTH": "sigma_hit grows with range",
    "SHARP": "the normal density's peak is so high that exponents need more than the working precision",
    "SINGLE": "the mixture has one continuous component",
    "LINEAR": "z_rand is large enough for the mixture to be summed as densities, not as logarithms",
    "SECTORS_2": "empty rectangles are made for 2 sectors of each quadrant's directions",
    "SECTORS_4": "empty rectangles are made for 4 of them",
    **casters.FLAGS,
    "AMCL_LINES": "Bresenham's lines are nav2_amcl's: they look one cell beyond their end, at ranges beyond range_max",
    "BELUGA_LINES": "Bresenham's lines are Beluga's: ties go straight on, and rays from outside the grid meet nothing",
    "ECHO": "a sensor hears the nearest of several rays, or its angle of incidence matters",
    "INCIDENCE": "the angle of incidence chooses the mixture's terms, or says whether anything returns",
    "SENSOR_TABLE": "log densities come from a table over readings and expected ranges",
    "CUBES": "a sum of cubes is wanted, as nav2_amcl and Beluga weigh scans",
    "AMCL": "the densities to be cubed are nav2_amcl's, not Beluga's",
    "WIDE": "a work-item computes 16 particles or beams at once, for processors whose compilers do not do so",
    "SHARED_RAYS": "several readings have the same bearing",
    "ALL_READINGS": "missing (nan) and max (inf) readings are evaluated too, as they are when nothing is left out",
    "HUGE_HEADINGS": "some heading is beyond 2^20 rad",
    "ORDERED": "particles come in an order in which neighbours have much the same position and heading",
    "STRANDED": "there are enough readings for a work-item to add up whole strands of them",
    "QUICK": "nearest cells are found by rounding, and again with more digits only where that is in doubt",
    "INSIDE": "no end point of the cloud leaves the field's table",
    "SCANS": "several scans are scored together, each with readings and particles of its own",
    "PER_BEAM": "the log-likelihood of each reading is wanted",
    "BILINEAR": "the field is interpolated",
    "LOG_TABLE": "the field's table holds log densities, not distances",
    "POSES_FLOAT32": "poses on the device are float32 numbers, as GPU frameworks hold them, not float64",
    "RANGES_FLOAT32": "readings on the device are float32 numbers, as GPU frameworks hold them, not float64",
    "SOME_BEAMS": "readings on the device are those of more beams than are used",
    "END_POINTS": "readings on the device become end points of beams, not rays with ranges",
    "RANGE": "some feature has a range",
    "BEARING": "some feature has a bearing",
    "SIGNATURE": "some feature has a signature",
    "FIELD": "the field of view is less than a full circle",
    "KNOWN": "it is known which landmark each feature is",
    "MARGINAL": "each feature's densities at all landmarks are summed",
    "INFORMATION": "the sums of the log-likelihood's second derivatives are wanted",
    "CAREFUL": "end points need more than the working precision to fall into the right cell",
}

_SCALARS: dict[str, np.dtype] = {
    "int": np.dtype(np.int32),
    "uchar": np.dtype(np.uint8),
    "ushort": np.dtype(np.uint16),
    "double": np.dtype(np.float64),
}
_WIDTHS = {"": 1, "2": 2, "4": 4}


def _evaluate(node: ast.expr, values: Mapping[str, Any]) -> int:
    match node:
        case ast.Constant(value=int(number)):
            return number
        case ast.Name(id=name):
            return int(values[name])
        case ast.Attribute(value=ast.Name(id=name), attr=field):
            return int(getattr(values[name], field))
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            return _evaluate(left, values) + _evaluate(right, values)
        case ast.BinOp(left=left, op=ast.Mult(), right=right):
            return _evaluate(left, values) * _evaluate(right, values)
    raise ValueError(f"shape: must be a sum or product of integers, names and fields, got {ast.unparse(node)!r}")


@dataclass(frozen=True)
class Argument:
    """One argument of a kernel: an array (with its shape in words), or a scalar or struct (shape None)."""

    name: str
    type: str
    shape: str | None = None
    output: bool = False

    @property
    def is_struct(self) -> bool:
        """Tell whether the argument is a struct."""
        return self.type in STRUCTS

    @property
    def width(self) -> int:
        """Numbers per element: 4 for real4."""
        return _WIDTHS[self.type.lstrip("abcdefghijklmnopqrstuvwxyz")]

    def elements(self, values: Mapping[str, Any]) -> int:
        """Return an array's number of elements: its shape sums and multiplies integers, scalars and structs' fields."""
        assert self.shape is not None
        return _evaluate(ast.parse(self.shape, mode="eval").body, values)

    def dtype(self, real: np.dtype) -> np.dtype:
        """NumPy dtype of one number of an array or scalar."""
        base = self.type.rstrip("24")
        return real if base == "real" else _SCALARS[base]


@dataclass(frozen=True)
class Kernel:
    """A kernel: the concept (file) it belongs to, what one work-item is, its arguments, and its work-group size.

    A global size's first axis is rounded up to whole groups; the heavier a work-item, the smaller its group. Where a
    kernel is compiled for several lanes (WIDE), its groups have ``wide_group`` work-items, and with ``wide`` each of
    them takes as many neighbours of the first axis as there are lanes.
    """

    file: str
    launch: tuple[str, ...]
    arguments: tuple[Argument, ...]
    group: int
    wide: bool = False
    wide_group: int = 1


# Particles or beams of a work-item of such a kernel.
LANES = 16


def lanes_of(flags: frozenset[str]) -> int:
    """How many particles or beams a work-item computes at once."""
    return LANES if "WIDE" in flags else 1


def _kernel(file: str, launch: str, *rows: str, group: int = 64, wide: bool = False, wide_group: int = 1) -> Kernel:
    arguments = []
    for row in rows:
        head, _, shape = row.partition("[")
        *output, kind, name = head.split()
        arguments.append(Argument(name, kind, shape.rstrip("]") if shape else None, output == ["out"]))
    return Kernel(file, tuple(launch.split()), tuple(arguments), group, wide, wide_group)


_MAP = ("int rows", "int cols")
_WINDOW = "Window window"
_POSES = ("int2 pose_cell [particles]", "real4 pose [particles]")
# Normals of the map's walls and of a ring of cells around it; not read without INCIDENCE.
_NORMALS = ("real2 normals [(window.rows + 2) * (window.cols + 2)]",)
_CONES = "real2 ray [rays * cone.rays]"
# A map as a caster has it: what an entry is, and how many there are, is the caster's.
_CAST = ("entry map_table [map]",)
_CASTING = ("Caster caster", "RangeScale scale")
_PLANES = "ushort rectangles [4 * sectors * (rows + 2) * (cols + 2)]"
_CHANGED = (
    *_MAP, "int sectors", "int first", "int band", "int top", "int left", "int bottom", "int right",
)  # fmt: skip
# Readings and expected ranges to learn from, in blocks of one length.
_PAIRS = ("real reading [blocks * readings]", "real expected [blocks * readings]")
_LANDMARKS = ("real4 landmark [landmarks]", "real4 signature [landmarks]")
_BUCKETS = "int start [buckets.rows * buckets.cols + 1]"
# Poses on their way into a window of the grid.
_GIVEN = (
    "coordinate poses [particles * 3]", "out int2 pose_cell [particles]", "out real4 pose [particles]",
    "out real4 pose_low [particles]", "out int pose_status [2]",
)  # fmt: skip
_FRAME = ("Frame frame", _WINDOW, "int particles")
_PLACED = (*_POSES, "real4 pose_low [particles]")
_FIELD_TABLE = "real table [(window.rows + 4) * (window.cols + 4)]"
_POINTS = ("real2 point [readings]", "real2 point_low [readings]", "real terms [6]")
_FEATURES = ("real feature [28 * features]",)
_MIXTURE = ("real terms [4]", "real2 arcs [11]")
_FEATURE_RESULT = (
    "out real log_p [particles]", "out real parts [particles * features]", "out int which [particles * features]",
)  # fmt: skip
_TERMS = (
    f"real terms [{MIXTURE_TERMS} * tables.incidence_bins]", "real edges [tables.incidence_bins]",
    "real sensor [(tables.cells + 1) * (tables.cells + 1)]",
)  # fmt: skip
# With SCANS: where the rays or end points of each scan begin, and its constant term.
_SCANS = ("int start [scans + 1]", "real constant_terms [scans]")
_RESULT = ("out real log_p [particles]", "out real parts [particles * readings]")
_SCORE = ("Score score", "ScanBatch batch")

KERNELS: dict[str, Kernel] = {
    "distance_lines": _kernel(
        "distance", "line", "uchar occupied [rows * cols]", "out int along [rows * cols]",
        "int lines", "int length", "int line_stride", "int step", group=16,
    ),
    "distance_envelope": _kernel(
        "distance", "line", "int along [rows * cols]", "out int starts [rows * cols]", "out int squared [rows * cols]",
        "int lines", "int length", "int line_stride", "int step", group=16,
    ),
    "distance_bits": _kernel(
        "distance", "col row", "int bits [rows * words]", "out ushort nearest [rows * cols]", *_MAP, "int words",
        "int reach",
    ),
    "distance_blocks": _kernel(
        "distance", "col block", "ushort nearest [rows * cols]", "out ushort blocks [count * cols]", *_MAP, "int count",
    ),
    "distance_search": _kernel(
        "distance", "col row", "ushort nearest [rows * cols]", "ushort blocks [count * cols]",
        "out int squared [rows * cols]", *_MAP, "int count", "int most",
    ),
    "free_columns": _kernel(
        "rectangles", "strip direction", "uchar occupied [band * cols]", "out uchar runs [2 * band * cols]",
        "int band", "int cols", "int begin", "int end", group=1,
    ),
    "rectangles_rows": _kernel(
        "rectangles", "row quadrant", "uchar runs [2 * band * cols]", "out int stack [1024 * rows]",
        f"out {_PLANES}", *_CHANGED, group=1,
    ),
    "free_rows": _kernel(
        "rectangles", "col row", "int bits [band * words]", "out uchar runs [2 * band * cols]", "int band", "int cols",
        "int words", "int begin", "int end",
    ),
    "rectangles_scan": _kernel(
        "rectangles", "col row quadrant", "uchar runs [2 * band * cols]", f"out {_PLANES}", *_CHANGED,
    ),
    "place_poses": _kernel("placement", "particle", *_GIVEN, *_FRAME),
    "place_inputs": _kernel(
        "scan", "item", *_GIVEN, "measured ranges [scan]", "int beam [beams]", "double vector [2 * each * beams]",
        "out real2 point [places * each]", "out real2 point_low [places]", "out real reading [places]",
        "out real guard [blocks]", "out real constant_term [1]", *_FRAME, "int head", "ReadingRules rules",
    ),
    "cast_ranges": _kernel(
        "ranges", "ray particle", *_CAST, *_POSES, "real2 ray [rays]", "out real ranges [particles * rays]", _WINDOW,
        "int particles", "int rays", *_CASTING, wide=True,
    ),
    "score_beams": _kernel(
        "beam", "particle", *_CAST, *_NORMALS, *_POSES, _CONES, "int first [rays + 1]", "real reading [readings]",
        *_TERMS, *_SCANS, *_RESULT, _WINDOW, "int particles", "int rays", "int readings", "MixtureTables tables",
        "Cone cone", *_CASTING, *_SCORE, wide_group=16,
    ),
    "cast_tiles": _kernel(
        "ranges", "item", *_CAST, *_POSES, "int order [particles]", "real2 ray [rays]",
        "out real ranges [particles * rays]", _WINDOW, "int particles", "int rays", *_CASTING, "int spread",
    ),
    "beam_tiles": _kernel(
        "beam", "item", *_CAST, *_NORMALS, *_POSES, "int order [particles]", _CONES, "int first [rays + 1]",
        "real reading [readings]", *_TERMS, "int start [scans + 1]", "out real parts [readings * particles]", _WINDOW,
        "int particles", "int rays", "int readings", "MixtureTables tables", "Cone cone", *_CASTING, "int spread",
        "ScanBatch batch",
    ),
    "cast_echoes": _kernel(
        "echo", "ray particle", *_CAST, *_NORMALS, *_POSES, _CONES, "out real ranges [particles * rays]",
        "out real incidence [particles * rays]", _WINDOW, "int particles", "int rays", "Cone cone", *_CASTING,
    ),
    "sum_parts": _kernel(
        "sums", "place", "real parts [count * particles]", "int order [particles]", "int counts [scans]",
        "real constant_terms [scans]", "out real log_p [particles]", "int particles", "int count", "int block",
        *_SCORE,
    ),
    "order_bounds": _kernel(
        "order", "bin", *_POSES, "out int bounds [7]", "out int bins [32768]", "int particles",
    ),
    "order_count": _kernel(
        "order", "particle", *_POSES, "int bounds [7]", "out int bins [32768]", "out int bin_of [particles]",
        "int particles",
    ),
    "order_starts": _kernel("order", "stretch", "out int bounds [7]", "out int bins [32768]"),
    "order_fill": _kernel(
        "order", "particle", "int bin_of [particles]", "out int bins [32768]", "out int order [particles]",
        "int particles",
    ),
    "fill_lookup": _kernel(
        "lookup_table", "bin cell", "ushort rectangles [map]", "real2 ray [bins]",
        "out ushort lookup [window.rows * window.cols * bins]", _WINDOW, "int bins", "int first_row", "int count",
        "real limit",
    ),
    "fill_field": _kernel(
        "field", "col row", "int squared [rows * cols]", "real density [cap + 1]",
        "out real table [begin + height * stride]", *_MAP, "int cap", "real beyond", "int from_col", "int from_row",
        "int width", "int height", "int begin", "int stride",
    ),
    "field_blocks": _kernel(
        "field", "item", _FIELD_TABLE, *_PLACED, *_POINTS, "real guard [readings]", "int start [scans + 1]",
        "out real parts [readings * particles]", _WINDOW, "int particles", "int readings", "int spread",
        "ScanBatch batch",
    ),
    "e_step": _kernel(
        "learning", "block", *_PAIRS, "real terms [12]", "out real sums [blocks * width]", "int blocks", "int readings",
        "int across", "int along", "int width",
    ),
    "pair_causes": _kernel(
        "learning", "block", *_PAIRS, "real terms [12]", "out real4 causes [blocks * readings]", "int blocks",
        "int readings", "int across", "int along",
    ),
    "score_field": _kernel(
        "field", "particle", _FIELD_TABLE, *_PLACED, *_POINTS, *_SCANS, *_RESULT, _WINDOW, "int particles",
        "int readings", "real guard", *_SCORE, wide=True,
    ),
    "score_features": _kernel(
        "landmark_score", "particle", *_LANDMARKS, _BUCKETS, *_PLACED, *_FEATURES, "int partner [features]",
        *_MIXTURE, *_FEATURE_RESULT, "Buckets buckets", "int landmarks", "int particles", "int features",
        "real share", "Score score", wide=True,
    ),
    "joint_features": _kernel(
        "landmark_joint", "particle", *_LANDMARKS, *_PLACED, *_FEATURES, *_MIXTURE,
        "out real best [particles * sets]", "out int choice [particles * sets * features]",
        "out real value [particles * sets * features]", *_FEATURE_RESULT, "int landmarks", "int particles",
        "int features", "int sets", "Buckets buckets", "Score score",
    ),
    "count_unseen": _kernel(
        "landmark_unseen", "particle", "real4 landmark [landmarks]", _BUCKETS, *_PLACED,
        "int which [particles * features]", "out real log_p [particles]", "Buckets buckets", "int particles",
        "int features", "SensorView view",
    ),
    "place_relative": _kernel(
        "relative", "particle", "coordinate poses [particles * 3]", "out real4 place [particles]",
        "out int pose_status [2]", "double origin_x", "double origin_y", "double mount_x", "double mount_y",
        "int particles",
    ),
    "wrap_headings": _kernel(
        "relative", "particle", "coordinate poses [particles * 3]", "out real2 residual [particles]",
        "out int pose_status [2]", "double target", "double target_low", "int particles",
    ),
    "score_position": _kernel(
        "absolute", "particle", "real4 place [particles]", "real terms [9]", "out real log_p [particles]",
        "int particles", "real temperature",
    ),
    "score_heading": _kernel(
        "absolute", "particle", "real2 residual [particles]", "real terms [12]", "out real log_p [particles]",
        "int particles", "int kind", "real temperature",
    ),
    "score_beacons": _kernel(
        "beacons", "particle", "real4 place [particles]", "real beacon [6 * beacons]", "real terms [13]",
        "real series [count]", "out real log_p [particles]", "int particles", "int beacons", "int count", "int kind",
        "real temperature",
    ),
    "score_contact": _kernel(
        "contact", "particle", "int table [(window.rows + 4) * (window.cols + 4)]", *_PLACED,
        "real2 point [points]", "real2 point_low [points]", "int start [segments + 1]", "int pressed [segments]",
        "real terms [10]", "out real log_p [particles]", _WINDOW, "int particles", "int segments",
        "real guard", "real temperature",
    ),
}  # fmt: skip
