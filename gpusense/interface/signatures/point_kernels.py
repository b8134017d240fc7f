"""Kernels of landmarks and of sensors without rays."""

from __future__ import annotations

from gpusense.interface.signatures.rows import PLACED, WINDOW, Kernel, kernel

_LANDMARKS = ("real4 landmark [landmarks]", "real4 normal [landmarks]", "real4 signature [landmarks]")
_BUCKETS = "int start [buckets.rows * buckets.cols + 1]"
_FEATURES = ("real feature [29 * features]",)
_MIXTURE = ("FeatureTerms terms [1]", "real2 arcs [11]")
_FEATURE_RESULT = (
    "out real log_p [particles]", "out real parts [particles * features]", "out int which [particles * features]",
)  # fmt: skip

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
        "landmark_unseen", "particle", "real4 landmark [landmarks]", _BUCKETS, *PLACED,
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
}  # fmt: skip
