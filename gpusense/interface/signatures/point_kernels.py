"""Kernels of landmarks, of sensors without rays, and of particle filters."""

from __future__ import annotations

from gpusense.interface.signatures.rows import PLACED, WINDOW, Kernel, kernel

_LANDMARKS = ("real4 landmark [landmarks]", "real4 normal [landmarks]", "real4 signature [landmarks]")
_BUCKETS = "int start [buckets.rows * buckets.cols + 1]"
_FEATURES = ("real feature [29 * features]",)
_MIXTURE = ("FeatureTerms terms [1]", "real2 arcs [11]")
_FEATURE_RESULT = (
    "out real log_p [particles]", "out real parts [particles * features]", "out int which [particles * features]",
)  # fmt: skip
_SETTINGS, _STATE = "double settings [64]", "double state [64]"
_SCORE, _BEFORE = "double score [particles]", "double before [particles]"
_LARGEST, _SUMS = "double largest [groups]", "double sums [17 * blocks]"
# Work-items read results of other work-items, so launches on a processor must not be split: no axis is named particle
# or block.

KERNELS: dict[str, Kernel] = {
    "score_features": kernel(
        "landmark_score", "particle", *_LANDMARKS, _BUCKETS, *PLACED, *_FEATURES, "int partner [features]",
        *_MIXTURE, *_FEATURE_RESULT, "Buckets buckets", "int landmarks", "int particles", "int features",
        "real share", "Score score", in_lanes=True,
    ),
    "joint_features": kernel(
        "landmark_joint", "particle", *_LANDMARKS, *PLACED, *_FEATURES, *_MIXTURE,
        "out real best [particles * sets]", "out int choice [particles * sets * features]",
        "out real value [particles * sets * features]", *_FEATURE_RESULT, "int landmarks", "int particles",
        "int features", "int sets", "Buckets buckets", "Score score",
    ),
    "count_unseen": kernel(
        "landmark_score", "particle", "real4 landmark [landmarks]", _BUCKETS, *PLACED,
        "int which [particles * features]", "out real log_p [particles]", "Buckets buckets", "int particles",
        "int features", "SensorView view", in_lanes=True,
    ),
    "place_relative": kernel(
        "relative", "particle", "coordinate poses [particles * 3]", "out real4 place [particles]",
        "out int pose_status [2]", "double origin_x", "double origin_y", "double mount_x", "double mount_y",
        "int particles",
    ),
    "wrap_headings": kernel(
        "relative", "particle", "coordinate poses [particles * 3]", "out real2 residual [particles]",
        "out int pose_status [2]", "double target", "double target_low", "int particles",
    ),
    "score_position": kernel(
        "absolute", "particle", "real4 place [particles]", "PositionTerms terms [1]", "out real log_p [particles]",
        "int particles", "real temperature", in_lanes=True,
    ),
    "score_heading": kernel(
        "absolute", "particle", "real2 residual [particles]", "HeadingTerms terms [1]", "real waves [6]",
        "out real log_p [particles]", "int particles", "int kind", "real temperature", in_lanes=True,
    ),
    "score_beacons": kernel(
        "beacons", "particle", "real4 place [particles]", "real beacon [7 * beacons]", "BeaconTerms terms [1]",
        "real series [count]", "out real log_p [particles]", "int particles", "int beacons", "int count", "int kind",
        "real temperature", in_lanes=True,
    ),
    "score_contact": kernel(
        "contact", "particle", "int table [(window.rows + 4) * (window.cols + 4)]", *PLACED,
        "real2 point [points]", "real2 point_low [points]", "int start [segments + 1]", "int pressed [segments]",
        "ContactTerms terms [1]", "out real log_p [particles]", WINDOW, "int particles", "int segments",
        "real guard", "real temperature", in_lanes=True,
    ),
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
