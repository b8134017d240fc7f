"""Kernels that place poses and readings, cast rays and score scans."""

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

KERNELS: dict[str, Kernel] = {
    "place_poses": kernel("placement", "particle", *_GIVEN, *_FRAME, in_lanes=True),
    "bound_numbers": kernel(
        "bounds", "item", "coordinate number [apart + count]", "out double bounds [2 * items]", "int count",
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
}  # fmt: skip
