"""Omissions of a landmark model: by its parameters, and by the features of a call."""

from __future__ import annotations

import numpy as np

from gpusense.interface.plan import Omission, share
from gpusense.models.landmark.features import PreparedFeatures
from gpusense.models.landmark.tables import full_circle
from gpusense.world.frames import Mount
from gpusense.world.landmarks import Buckets
from gpusense.world.parameters import LandmarkParameters


def looked_at(prepared: PreparedFeatures, buckets: Buckets) -> float:
    """Return the landmarks that a feature inspects, on average over an evenly filled map."""
    side, (rows, cols) = buckets.resolution, buckets.shape
    across = np.maximum(2 * prepared.radius, 0) + side
    looked = np.minimum(across, rows * side) * np.minimum(across, cols * side) / (rows * cols * side**2)
    return float(len(buckets.index) * np.minimum(looked, 1).mean()) if len(looked) else 0.0


def parameter_omissions(p: LandmarkParameters, negative: bool, mount: Mount, precision: str) -> list[Omission]:
    """Return the omissions of every call, by the parameters."""
    omissions = [
        Omission(name[6:], f"{name} = None", cost)
        for name, cost in (
            ("sigma_range", "1 exponent per particle, feature and landmark"),
            ("sigma_bearing", "1 arc tangent and 1 exponent per particle, feature and landmark"),
            ("sigma_signature", "1 exponent per particle, feature and landmark"),
        )
        if getattr(p, name) is None
    ]
    if full_circle(p):
        omissions.append(Omission("mass in the field of view", "it is a full circle", "2 erf or more per landmark"))
    if not negative:
        omissions.append(Omission("negative information", "negative=False", "a look at all landmarks in view"))
    return omissions + common_omissions(mount, precision)


def common_omissions(mount: Mount, precision: str) -> list[Omission]:
    """Return the omissions of every call, of landmarks and of lines."""
    omissions = []
    if mount[:2] == (0.0, 0.0):
        omissions.append(Omission("mount", "the sensor sits at the robot's origin", "a rotation per particle"))
    if precision == "float32":
        why = "positions, angles and exponents are kept in two numbers"
        omissions.append(Omission("float64", why, "wide units, which many devices lack"))
    return omissions


def feature_omissions(
    prepared: PreparedFeatures, buckets: Buckets, *, name: str, total: int, impossible: int, known: bool
) -> list[Omission]:
    """Return the omissions by the features of a call.

    ``impossible``: number of features that the sensor cannot have measured; ``known``: True if the correspondences are
    known.
    """
    omissions, count = [], len(buckets.index)
    silent = total - len(prepared.columns) - impossible
    for number, what, why in (
        (impossible, "impossible features", "have a part that the sensor cannot measure"),
        (silent, "features", "do not depend on the pose"),
    ):
        if number:
            omissions.append(Omission(what, f"{number} of {total} features {why}", f"{share(number, total)} of them"))
    if known:
        omissions.append(Omission("search", "correspondences are known", f"{count - 1} of {count} {name}"))
    elif len(prepared.columns) and np.isfinite(prepared.radius).any():
        spared = count - looked_at(prepared, buckets)
        if spared >= 0.5:
            why = f"beyond {prepared.radius.max():.3g} m of where features point densities are below eps of the rest"
            omissions.append(Omission(f"far {name}", why, f"about {share(spared, count)} of {count} {name}"))
    return omissions
