"""The flag of kernels in vectors, which compute several particles or beams at once on devices that ask for lanes."""

from __future__ import annotations

from gpusense.interface import casters

# A kernel has no body in vectors with any of these flags, nor without all flags of one of its sets.
_NEVER = {"FLOAT64", "ALL_READINGS", "SHARP", "SHARED_RAYS", "ECHO", "SENSOR_TABLE", "CUBES", *casters.FLAGS}
# Kernels in vectors of float64: the sums of learning.
_FLOAT64 = {"e_step"}
_NEVER_OF = {"score_features": {"SIGNATURE", "FIELD", "MARGINAL", "PER_BEAM", "LINE"}}
_NEEDED: dict[str, tuple[set[str], ...]] = {
    "cast_ranges": (set(),),
    "draw_particles": (set(),),
    "e_step": (set(),),
    "field_gradient": ({"LINEAR"},),
    "fit_lines": (set(),),
    "match_scans": (set(),),
    "move_particles": (set(),),
    "place_poses": (set(),),
    "score_beams": ({"LINEAR"},),
    "score_features": ({"RANGE"}, {"BEARING"}),
    "score_field": ({"LOG_TABLE"}, {"BILINEAR", "LINEAR"}),
    "set_weights": (set(),),
    "shift_scores": (set(),),
    "sum_poses": (set(),),
    "weigh_particles": (set(),),
}


def widened(lanes: int, kernel: str, flags: frozenset[str] | set[str]) -> frozenset[str]:
    """Return the flags of a launch, with WIDE where the device asks for lanes and the kernel has a body in vectors."""
    never = (_NEVER | _NEVER_OF.get(kernel, set())) - ({"FLOAT64"} if kernel in _FLOAT64 else set())
    if lanes == 1 or flags & never or not any(needed <= flags for needed in _NEEDED.get(kernel, ())):
        return frozenset(flags)
    return frozenset(flags) | {"WIDE"}
