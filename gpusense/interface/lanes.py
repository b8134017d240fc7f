"""Flags of kernels in lanes, which compute several particles or beams at once, and in teams, which share an item."""

from __future__ import annotations

import functools
from collections.abc import Callable

from gpusense.interface.signatures import KERNELS, team_of

# By kernel: flags with which it has no body in lanes, and sets of flags of which it requires at least one.
_SCALAR = frozenset({"FLOAT64", "ALL_READINGS", "EXACT_EXPONENT", "CUBES"})
_NEVER: dict[str, frozenset[str]] = {
    "cast_ranges": frozenset(),
    "e_step": _SCALAR - {"FLOAT64"},
    "score_beams": frozenset(),
    "score_field": frozenset({"ALL_READINGS", "WORLDS"}),
    "score_features": _SCALAR | {"LINE"},
}
_NEEDED: dict[str, tuple[set[str], ...]] = {
    "cast_ranges": (set(),),
    "count_unseen": (set(),),
    "draw_particles": (set(),),
    "e_step": (set(),),
    "field_gradient": ({"LINEAR"},),
    "fit_lines": (set(),),
    "match_scans": (set(),),
    "move_particles": (set(),),
    "place_pair": (set(),),
    "place_poses": (set(),),
    "score_beacons": (set(),),
    "score_beams": (set(),),
    "score_contact": (set(),),
    "score_features": ({"RANGE"}, {"BEARING"}),
    "score_field": (set(),),
    "score_heading": (set(),),
    "score_position": (set(),),
    "set_weights": (set(),),
    "shift_scores": (set(),),
    "sum_poses": (set(),),
    "weigh_particles": (set(),),
}
# By kernel: flags with which its body in lanes computes in float64 where real numbers are float32.
_DOUBLE: dict[str, frozenset[str]] = {"score_field": frozenset({"BILINEAR"})}
# By kernel: flags with which Warp's body has no loops that become vectors, and flags that it requires.
_NO_LOOPS = {
    "score_beams": frozenset({"FLOAT64", "SENSOR_TABLE"}),
    "score_field": frozenset({"ALL_READINGS", "SHAPES"}),
}
_IN_LOOPS: dict[str, frozenset[str]] = {"score_beams": frozenset(), "score_field": frozenset({"BILINEAR"})}
# Flags of teams, the largest first.
_TEAMS = (frozenset({"IN_TEAMS"}), frozenset({"IN_TEAMS", "SMALL_TEAMS"}))


def with_lanes_flag(
    lanes: int, kernel: str, flags: frozenset[str] | set[str], *, float64: bool = True
) -> frozenset[str]:
    """Return the flags of a launch, with IN_LANES where device and kernel compute in lanes.

    ``float64``: True if the device has float64, which some bodies in lanes need.
    """
    return _flagged(lanes, kernel, frozenset(flags), float64)


@functools.lru_cache(maxsize=256)
def _flagged(lanes: int, kernel: str, flags: frozenset[str], float64: bool) -> frozenset[str]:
    """See ``with_lanes_flag``; calls repeat the flags of earlier ones."""
    never = _NEVER.get(kernel, _SCALAR)
    if not float64 and kernel in _DOUBLE and _DOUBLE[kernel] <= flags:
        return flags
    if lanes == 1 or flags & never or not any(needed <= flags for needed in _NEEDED.get(kernel, ())):
        return flags
    return flags | {"IN_LANES"}


def with_loops_flag(vector_loops: bool, kernel: str, flags: frozenset[str]) -> frozenset[str]:
    """Return the flags of a launch, with IN_LANES where the compiler makes vectors of the kernel's loops over readings.

    ``vector_loops``: as in ``BackendInfo``.
    """
    if not vector_loops or flags & _NO_LOOPS[kernel] or not _IN_LOOPS[kernel] <= flags:
        return flags
    return flags | {"IN_LANES"}


def with_teams_flags(
    kind: str, kernel: str, flags: frozenset[str], points: int, largest_group: Callable[[str, frozenset[str]], int]
) -> tuple[frozenset[str], int]:
    """Return the flags of a launch, including flags of teams on a GPU, and the work-items of an item.

    A team is the smallest with a work-item for every two points, or the largest that the device holds.

    ``largest_group``: ``Backend.largest_group`` of the device.
    """
    if kind != "gpu":
        return flags, 1
    teams = [(team_of(KERNELS[kernel], flags | more), flags | more) for more in _TEAMS]
    enough = sum(2 * team >= points for team, _ in teams)
    for team, shared in teams[max(enough - 1, 0) :]:
        if team <= largest_group(kernel, shared):
            return shared, team
    return flags, 1
