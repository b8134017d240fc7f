"""Which scenes have kernels that compute several particles or beams at once, for devices that ask for lanes."""

from __future__ import annotations

from gpusense.interface import casters

# A kernel has no such variant with these flags, some of them of its own, or without all of some set of those.
_NEVER = {"FLOAT64", "ALL_READINGS", "SHARP", "SHARED_RAYS", "ECHO", "SENSOR_TABLE", "CUBES", *casters.FLAGS}
# Only sums to learn from have lanes of float64.
_FLOAT64 = {"e_step"}
_NEVER_OF = {"score_features": {"SIGNATURE", "FIELD", "MARGINAL", "PER_BEAM"}}
_NEEDED: dict[str, tuple[set[str], ...]] = {
    "cast_ranges": (set(),),
    "e_step": (set(),),
    "score_beams": ({"LINEAR"},),
    "score_features": ({"RANGE"}, {"BEARING"}),
    "score_field": ({"LOG_TABLE"}, {"BILINEAR", "LINEAR"}),
}


def widened(lanes: int, kernel: str, flags: frozenset[str] | set[str]) -> frozenset[str]:
    """The flags of a launch on a device, with WIDE where it asks for lanes and the scene has such a kernel."""
    never = (_NEVER | _NEVER_OF.get(kernel, set())) - ({"FLOAT64"} if kernel in _FLOAT64 else set())
    if lanes == 1 or flags & never or not any(needed <= flags for needed in _NEEDED[kernel]):
        return frozenset(flags)
    return frozenset(flags) | {"WIDE"}
