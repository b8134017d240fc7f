"""Kernels of particle filters."""

from __future__ import annotations

from gpusense.interface.signatures.rows import Kernel, kernel

_SETTINGS, _STATE = "double settings [64]", "double state [64]"
_SCORE, _BEFORE = "double score [particles]", "double before [particles]"
_LARGEST, _SUMS = "double largest [groups]", "double sums [17 * blocks]"
# Work-items read results of other work-items, so launches on a processor must not be split: no axis is named particle
# or block.
KERNELS: dict[str, Kernel] = {
    "move_particles": kernel(
        "motion", "pose", "double source [3 * particles]", _SETTINGS, "out double target [3 * particles]",
        "int particles", "int kind", in_lanes=True,
    ),
    "add_scores": kernel(
        "weighing", "group", "real log_p [particles]", _SETTINGS, f"out {_SCORE}", "out double largest [particles]",
        "int particles", "int block", "int sensor", group=16,
    ),
    "join_scores": kernel(
        "weighing", "group", "double scores [blocks]", "out double largest [1]", "int blocks", "int fan", group=16,
    ),
    "weigh_particles": kernel(
        "weighing", "group", _SCORE, _BEFORE, _LARGEST, _SETTINGS, _STATE, f"out {_SUMS}", "out double highest [1]",
        "int particles", "int block", "int blocks", "int groups", "int stage", group=16,
    ),
    "join_rows": kernel(
        "weighing", "column", "out double sums [columns * rows]", "out double joined [columns]", "int rows",
        "int columns", "int fan", group=16,
    ),
    "set_weights": kernel(
        "weighing", "group", _SCORE, _BEFORE, "double highest [1]", _SUMS, "double joined [17]", "double totals [17]",
        _SETTINGS, f"out {_STATE}", "out double weight [particles]", "out double ends [particles]", "int particles",
        "int block", "int blocks", "int fan", "int stage", "int stages", group=16,
    ),
    "count_copies": kernel(
        "drawing", "group", "double ends [particles]", _STATE, f"out {_SUMS}", "int particles", "int block",
        "int blocks", "int drawn", "int stage", group=16,
    ),
    "set_copies": kernel(
        "drawing", "group", "double ends [particles]", _STATE, _SUMS, "double joined [17]",
        "out double copies [particles]", "int particles", "int block", "int blocks", "int fan", "int drawn",
        "int stage", group=16,
    ),
    "draw_particles": kernel(
        "drawing", "pose", "double source [3 * particles]", "double weight [particles]", "double ends [particles]",
        "double copies [particles]", _SETTINGS, _STATE, "double pool [3]", "out double target [3 * drawn]",
        "out double after [drawn]", "int particles", "int drawn", "int stage", in_lanes=True,
    ),
    "sum_poses": kernel(
        "estimate", "group", "double poses [3 * particles]", "double weight [particles]", "double estimate [11]",
        "out double sums [13]", "int particles", "int block", "int lanes", "int second_pass", group=16,
    ),
    "finish_estimate": kernel(
        "estimate", "whole", "double poses [3]", "double sums [13 * groups]", "out double estimate [11]", "int groups",
        "int second_pass", group=1,
    ),
    "normalize_weights": kernel(
        "estimate", "pose", "double weight [particles]", "double estimate [11]", "out double share [particles]",
        "int particles",
    ),
}  # fmt: skip
