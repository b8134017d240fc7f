"""Small scenes for the landmark model: landmarks, a cloud of particles around a pose, features seen from the pose."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

import gpusense as gs

NAN = np.nan


@dataclass(frozen=True)
class Scene:
    """Parameters other than the defaults, the model's options, and unmeasured parts of features."""

    parameters: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    missing: tuple[tuple[int, int], ...] = ()
    origin: tuple[float, float] = (0.0, 0.0)
    turn: float = 0.0


SCENES = {
    "ordinary": Scene(),
    "everything": Scene(
        dict(sigma_signature=0.3, field_of_view=4.5, sigma_bearing=0.2, range_max=12.0),
        dict(mount=(0.3, -0.2, 0.5)),
        ((1, 0), (2, 1), (3, 2), (4, 0), (4, 1)),
    ),
    "ranges": Scene(dict(sigma_bearing=None)),
    "bearings": Scene(dict(sigma_range=None)),
    "sharp": Scene(dict(sigma_range=1e-3, sigma_bearing=1e-4)),
    "needles": Scene(dict(sigma_range=1e-8, sigma_bearing=1e-8)),
    "flat": Scene(dict(sigma_range=1e6, sigma_bearing=1e6)),
    "needle and flat": Scene(dict(sigma_range=1e-8, sigma_bearing=1.0)),
    "flat and needle": Scene(dict(sigma_range=1e6, sigma_bearing=1e-8)),
    "no false positives": Scene(dict(z_detect=1.0, z_false=0.0)),
    "only false positives": Scene(dict(z_detect=0.0, z_false=1.0)),
    "few false positives": Scene(dict(z_detect=1.0, z_false=1e-30)),
    "wide field": Scene(dict(field_of_view=6.0, sigma_bearing=1.5)),
    "narrow field": Scene(dict(field_of_view=0.9, sigma_bearing=0.3)),
    "far origin": Scene(origin=(5e6, -5e6), turn=1e6),
}
# Landmarks 0 and 1 coincide, 2, 3 and 4 are on a line with the pose's x axis.
XY = np.array([[3.0, 1.0], [3.0, 1.0], [6.0, 0.0], [9.0, 0.0], [-4.0, 0.0], [-2.0, 5.0], [0.5, -7.0]])
SIGNATURES = np.array([1.0, 1.5, 2.0, 2.0, 3.0, 4.0, 7.0])
SEEN = (0, 2, 4, 5, 6)


def make(name: str) -> tuple[gs.LandmarkMap, gs.LandmarkParameters, np.ndarray, np.ndarray, dict[str, Any]]:
    """Return map, parameters, poses, features and the model's options of a scene."""
    scene = SCENES[name]
    rng = np.random.default_rng(len(name))
    parameters = gs.LandmarkParameters(**scene.parameters)
    mx, my, yaw = scene.options.get("mount", (0.0, 0.0, 0.0))
    # The sensor at the origin looks along x and sees landmark 4 across +-pi.
    c, s = np.cos(-yaw), np.sin(-yaw)
    pose = np.array([-(c * mx - s * my), -(s * mx + c * my), -yaw])
    noise = [sigma if sigma is not None and sigma < 1 else 0.1 for sigma in
             (parameters.sigma_range, parameters.sigma_bearing, parameters.sigma_signature)]  # fmt: skip
    xy = XY[list(SEEN)]
    features = np.stack([np.hypot(*xy.T), np.arctan2(xy[:, 1], xy[:, 0]), SIGNATURES[list(SEEN)]], axis=1)
    features += rng.normal(0, 1, features.shape) * noise
    half = parameters.field_of_view / 2
    if half < np.pi:
        features[:, 1] = np.clip((features[:, 1] + np.pi) % (2 * np.pi) - np.pi, -half, half)
    features[:, 0] = np.clip(features[:, 0], 0, parameters.range_max)
    for k, column in scene.missing:
        features[k, column] = NAN
    poses = pose + rng.normal(0, 1, (7, 3)) * (0.2, 0.2, 0.05)
    poses[0] = pose
    # A sensor on a landmark, and one far away.
    poses[1, :2] = (3.0, 1.0) if yaw == 0 else poses[1, :2]
    poses[2, :2] = (300.0, -200.0)
    poses[:, :2] += scene.origin
    poses[:, 2] += scene.turn
    landmarks = gs.LandmarkMap(XY + scene.origin, SIGNATURES)
    if parameters.sigma_signature is None:
        features = features[:, :2]
    return landmarks, parameters, poses, features, dict(scene.options)


def model(name: str, backend: str, **options: Any) -> tuple[gs.LandmarkModel, np.ndarray, np.ndarray]:
    """Return a scene's model, poses and features."""
    landmarks, parameters, poses, features, own = make(name)
    return gs.LandmarkModel(landmarks, parameters, backend=backend, **{**own, **options}), poses, features
