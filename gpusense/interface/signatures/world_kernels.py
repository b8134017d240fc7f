"""Kernels of many worlds: their tables, moving shapes, and poses in them; see the kernel file ``worlds``."""

from __future__ import annotations

from gpusense.interface.signatures.rows import POSES, Kernel, kernel

_SIZE = ("int rows", "int cols", "int worlds")
_PLACE = "int place [worlds]"
_FRAMES = "double frames [8 * worlds]"
_RULES = ("int threshold", "int unknown")

KERNELS: dict[str, Kernel] = {
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
        "worlds", "item", "real shapes [crowd.stride]", "int2 world [2 * particles]", *POSES,
        "out int sights [2 * crowd.begin]", "int particles", "Crowd crowd",
    ),
    "place_shapes": kernel(
        "worlds", "shape world", "coordinate raw [worlds * count * numbers]", _FRAMES,
        "out real shapes [worlds * stride]",
        "Frame frame", "int count", "int numbers", "int begin", "int stride", "int worlds",
    ),
    "find_collisions": kernel(
        "worlds", "particle", "uchar store [map]", "int2 world [2 * particles]", "real shapes [crowd.stride]", *POSES,
        "out uchar hit [particles]", "int particles", "real radius", "Crowd crowd", *_RULES,
    ),
}  # fmt: skip
