"""Which scenes have kernels that compute several particles or beams at once, for devices that ask for lanes."""

from __future__ import annotations

from gpusense.backends.base import BackendInfo
from gpusense.signatures import CASTER_FLAGS

# A kernel has no such variant with these flags, or without those.
_NEVER = {"FLOAT64", "ALL_READINGS", "SHARP", "SHARED_RAYS", "SENSOR_TABLE", "CUBES", "BILINEAR", *CASTER_FLAGS}
_NEEDED = {"cast_ranges": set(), "score_beams": {"LINEAR"}, "score_field": {"LOG_TABLE"}}


def widened(info: BackendInfo, kernel: str, flags: frozenset[str] | set[str]) -> frozenset[str]:
    """The flags of a launch on a device, those of its lanes added where the scene has such a kernel."""
    if info.lanes == 1 or flags & _NEVER or not _NEEDED[kernel] <= flags:
        return frozenset(flags)
    return frozenset(flags) | {"WIDE"} | ({"LANES_16"} if info.lanes == 16 else set())
