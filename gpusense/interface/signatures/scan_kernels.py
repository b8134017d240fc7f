"""Kernels that place poses and readings, cast rays and score scans, and make tables of maps and of many worlds."""

from __future__ import annotations

from gpusense.interface.constants import DRAW_TERMS
from gpusense.interface.signatures.rows import PLACED, POSES, WINDOW, Kernel, kernel

# Normals of the cells of the map and of a ring around it.
_NORMALS = ("real2 normals [(window.rows + 2) * (window.cols + 2)] if INCIDENCE",)
_CONES = "real2 ray [rays * cone.rays]"
# A map's table for a caster, which defines its entries and their number.
# See the kernel file ``shapes``.
_WORLDS = ("int2 world [2 * particles] if WORLDS", "real shapes [crowd.stride] if SHAPES")
_CAST = ("entry map_table [map]", *_WORLDS)
_CROWD = "Crowd crowd if SHAPES"
_CASTING = ("Caster caster", "RangeScale scale", _CROWD)
# Poses on their way into a window of the grid.
_GIVEN = (
    "coordinate poses [particles * 3]", "out int2 pose_cell [particles]", "out real4 pose [particles]",
    "out real4 pose_low [particles]", "out int pose_status [2]",
)  # fmt: skip
_FRAME = ("Frame frame", WINDOW, "int particles")
_POINTS = ("real2 point [readings]", "real2 point_low [readings]", "FieldTerms terms [1]")
_TERMS = (
    "MixtureTerms terms [tables.incidence_bins]", "real masses [1] if MASS_TABLE",
    "real edges [tables.incidence_bins] if INCIDENCE",
    "real sensor [(tables.cells + 1) * (tables.cells + 1)] if SENSOR_TABLE",
)  # fmt: skip
# Index of the first ray or end point of each scan, and the scan's constant term.
_START = "int start [scans + 1] if SCANS"
_SCANS = (_START, "real constant_terms [scans] if SCANS")
_BATCH = "ScanBatch batch if SCANS"
_ORDER = "int order [particles] if ORDERED"
_FIRST = "int first [rays + 1] if SHARED_RAYS"
_RESULT = ("out real log_p [particles]", "out real parts [particles * readings] if PER_BEAM")
_SCORE = ("Score score", _BATCH)
_FIELD_TABLE = "real table [(window.rows + 4) * (window.cols + 4)]"
_MAP = ("int rows", "int cols")
_PLANES = "out ushort rectangles [4 * sectors * lines * (cols + 2)]"
_CHANGED = (
    *_MAP, "int sectors", "int first", "int band", "int top", "int left", "int bottom", "int right", "int worlds",
)  # fmt: skip
_SIZE = ("int rows", "int cols", "int worlds")
_PLACE = "int place [worlds]"
_FRAMES = "double frames [8 * worlds]"
_RULES = ("int threshold", "int unknown")

KERNELS: dict[str, Kernel] = {
    "place_poses": kernel("placement", "particle", *_GIVEN, *_FRAME, in_lanes=True),
    "bound_numbers": kernel(
        "placement", "item", "coordinate number [apart + count]", "out double bounds [2 * items]", "int count",
        "int apart", "int items",
    ),
    "place_inputs": kernel(
        "scan", "item", *_GIVEN, "measured ranges [scan]", "int beam [beams]",
        "double vector [2 * rays_per_beam * beams]",
        "out real2 point [places * rays_per_beam]", "out real2 point_low [places]", "out real reading [places]",
        "out real guard [blocks]", "out real constant_term [1]", *_FRAME, "int head", "ReadingRules rules",
    ),
    "place_scans": kernel(
        "scan", "item", "measured ranges [scans * head]", "int beam [rules.beams]",
        "double vector [2 * rules.rays_per_beam * rules.beams]",
        "out real2 point [scans * rules.beams * rules.rays_per_beam]",
        "out real2 point_low [scans * rules.beams]", "out real reading [scans * rules.beams]",
        "out real guard [scans * blocks]", "int scans", "int head", "int blocks", "double resolution",
        "ReadingRules rules",
    ),
    "cast_ranges": kernel(
        "ranges", "ray particle", *_CAST, *POSES, "real2 ray [rays]", "out real ranges [particles * rays]", WINDOW,
        "int particles", "int rays", *_CASTING, in_lanes=True, lanes_group=8,
    ),
    "score_beams": kernel(
        "beam", "particle", *_CAST, *_NORMALS, *POSES, _CONES, _FIRST, "real reading [readings]",
        *_TERMS, *_SCANS, *_RESULT, WINDOW, "int particles", "int rays", "int readings", "MixtureTables tables",
        "Cone cone", *_CASTING, *_SCORE, lanes_group=16,
    ),
    "cast_tiles": kernel(
        "ranges", "item", *_CAST, *POSES, _ORDER, "real2 ray [rays]",
        "out real ranges [particles * rays]", WINDOW, "int particles", "int rays", *_CASTING, "int spread",
        apart=True,
    ),
    "cast_among_shapes": kernel(
        "ranges", "item", *_CAST, *POSES, "real2 ray [rays]", "int turns [4097 + rays]",
        "out real ranges [particles * rays]", "int particles", "int rays", *_CASTING, "int each", apart=True, team=64,
        registers=40,
    ),
    "beam_tiles": kernel(
        "beam", "item", *_CAST, *_NORMALS, *POSES, _ORDER, _CONES, _FIRST, "real reading [readings]", *_TERMS,
        _START, "out real parts [readings * particles]", WINDOW,
        "int particles", "int rays", "int readings", "MixtureTables tables", "Cone cone", *_CASTING, "int spread",
        _BATCH, apart=True,
    ),
    "cast_echoes": kernel(
        "echo", "ray particle", *_CAST, *_NORMALS, *POSES, _CONES, "out real ranges [particles * rays]",
        "out real incidence [particles * rays] if INCIDENCE",
        WINDOW, "int particles", "int rays", "Cone cone", *_CASTING,
    ),
    "draw_readings": kernel(
        "sampling", "ray particle", "real incidence [particles * rays]",
        f"double mixture [{DRAW_TERMS} * tables.incidence_bins]", "real edges [tables.incidence_bins]",
        "double chances [(tables.cells + 1) * (tables.cells + 1)]",
        "double settings [9]", "out real ranges [particles * rays]", "int particles", "int rays",
        "MixtureTables tables", "RangeScale scale",
    ),
    "sum_parts": kernel(
        "sums", "place", "real parts [count * particles]", _ORDER, "int counts [scans] if SCANS",
        "real constant_terms [scans] if SCANS", "out real log_p [particles]", "int particles", "int count", "int block",
        *_SCORE,
    ),
    "order_bounds": kernel(
        "order", "bin", *POSES, "out int bounds [7]", "out int bins [32768]", "int particles",
    ),
    "order_count": kernel(
        "order", "particle", *POSES, "int bounds [7]", "out int bins [32768]", "out int bin_of [particles]",
        "int particles",
    ),
    "order_starts": kernel("order", "stretch", "out int bounds [7]", "out int bins [32768]"),
    "order_fill": kernel(
        "order", "particle", "int bin_of [particles]", "out int bins [32768]", "out int order [particles]",
        "int particles",
    ),
    "field_blocks": kernel(
        "field", "item", _FIELD_TABLE, *_WORLDS, *PLACED, *_POINTS, "real guard [readings]", _START,
        "out real parts [readings * particles]", WINDOW, "int particles", "int readings", "int spread",
        _BATCH, _CROWD,
    ),
    "score_field": kernel(
        "field", "particle", _FIELD_TABLE, *_WORLDS, *PLACED, *_POINTS, *_SCANS, *_RESULT, WINDOW, "int particles",
        "int readings", "real guard", *_SCORE, _CROWD, in_lanes=True,
    ),
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
        "out int stack [1024 * rows * worlds]", _PLANES, *_CHANGED, "int lines", "int group", group=1,
    ),
    "free_rows": kernel(
        "rectangles", "col row", "int bits [band * words]", "out uchar runs [2 * band * cols]", "int band", "int cols",
        "int words", "int begin", "int end",
    ),
    "rectangles_scan": kernel(
        "rectangles", "col tile quadrant", "uchar runs [2 * band * cols * worlds]", "int place [worlds]",
        _PLANES, *_CHANGED, "int lines", "int group", "int tall",
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
    "put_cells": kernel(
        "worlds", "item world", "uchar cells [worlds * count]", _PLACE, "out uchar store [map]", "int count",
        "int worlds", "int items",
    ),
    "mark_obstacles": kernel(
        "worlds", "item", "uchar store [map]", _PLACE, "out uchar occupied [map]", "out int bits [map]", *_SIZE,
        "int words", "int margin", *_RULES, "int as_bits",
    ),
    "fill_worlds": kernel(
        "worlds", "col line", "int squared [map]", "real density [cap + 1]", _PLACE, "out real table [map]", *_SIZE,
        "int margin", "int cap", "real beyond",
    ),
    "place_in_worlds": kernel(
        "worlds", "particle", "coordinate poses [particles * 3]", "int index [wide * particles]",
        "int ignore [wide_ignore * particles]",
        _FRAMES, "real shapes [crowd.stride]", "out int2 pose_cell [particles]", "out real4 pose [particles]",
        "out real4 pose_low [particles]",
        "out int2 world [2 * particles]", "out int pose_status [2]", "Frame frame", "int particles", "int worlds",
        "int wide", "int wide_ignore", "Crowd crowd",
    ),
    "find_sights": kernel(
        "crowd", "item", "real shapes [crowd.stride]", "int2 world [2 * particles]", *POSES,
        "out int sights [2 * crowd.begin]", "int particles", "Crowd crowd",
    ),
    "meet_shapes": kernel(
        "crowd", "particle", "real shapes [crowd.stride]", "int2 world [2 * particles]", *POSES, "real2 ray [rays]",
        "int turns [4097 + rays]", "out real ranges [particles * rays]", "int particles", "int rays", "real limit",
        "Crowd crowd",
    ),
    "place_shapes": kernel(
        "crowd", "shape world", "coordinate raw [worlds * count * numbers]", _FRAMES,
        "out real shapes [worlds * stride]",
        "Frame frame", "int count", "int numbers", "int begin", "int stride", "int worlds",
    ),
    "find_collisions": kernel(
        "worlds", "particle", "uchar store [map]", "int2 world [2 * particles]", "real shapes [crowd.stride]", *POSES,
        "out uchar hit [particles]", "int particles", "real radius", "Crowd crowd", *_RULES,
    ),
}  # fmt: skip
