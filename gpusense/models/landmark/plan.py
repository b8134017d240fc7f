"""What a landmark model leaves out: by its parameters, and by the features of a call."""

from __future__ import annotations

import numpy as np

from gpusense.interface.plan import Omission, share
from gpusense.models.landmark.features import PreparedFeatures, full_circle
from gpusense.world.frames import Mount
from gpusense.world.landmarks import Buckets
from gpusense.world.parameters import LandmarkParameters


def looked_at(prepared: PreparedFeatures, buckets: Buckets) -> float:
    """Landmarks that a feature looks at, on average over a map that is evenly filled."""
    side, (rows, cols) = buckets.resolution, buckets.shape
    across = np.maximum(2 * prepared.radius, 0) + side
    looked = np.minimum(across, rows * side) * np.minimum(across, cols * side) / (rows * cols * side**2)
    return float(len(buckets.index) * np.minimum(looked, 1).mean()) if len(looked) else 0.0


def parameter_omissions(p: LandmarkParameters, negative: bool, mount: Mount, precision: str) -> list[Omission]:
    """What no call needs."""
    found = [
        Omission(name[6:], f"{name} = None", cost)
        for name, cost in (
            ("sigma_range", "1 exponent per particle, feature and landmark"),
            ("sigma_bearing", "1 arc tangent and 1 exponent per particle, feature and landmark"),
            ("sigma_signature", "1 exponent per particle, feature and landmark"),
        )
        if getattr(p, name) is None
    ]
    if full_circle(p):
        found.append(Omission("mass in the field of view", "it is a full circle", "2 erf or more per landmark"))
    if not negative:
        found.append(Omission("negative information", "negative=False", "a look at all landmarks in view"))
    if mount[:2] == (0.0, 0.0):
        found.append(Omission("mount", "the sensor sits at the robot's origin", "a rotation per particle"))
    if precision == "float32":
        why = "positions, angles and exponents are kept in two numbers"
        found.append(Omission("float64", why, "wide units, which many devices lack"))
    return found


def feature_omissions(
    prepared: PreparedFeatures, buckets: Buckets, *, given: int, impossible: int, known: bool
) -> list[Omission]:
    """What a call's features do not need.

    Args:
        prepared: Features that are evaluated.
        buckets: The map.
        given: Features of the call.
        impossible: How many of them the sensor cannot have measured.
        known: Whether it is given which landmarks they are.
    """
    found, count = [], len(buckets.index)
    silent = given - len(prepared.columns) - impossible
    for number, what, why in (
        (impossible, "impossible features", "have a part that the sensor cannot measure"),
        (silent, "features", "do not depend on the pose"),
    ):
        if number:
            found.append(Omission(what, f"{number} of {given} features {why}", f"{share(number, given)} of them"))
    if known:
        found.append(Omission("search", "correspondences are known", f"{count - 1} of {count} landmarks"))
    elif len(prepared.columns) and np.isfinite(prepared.radius).any():
        spared = count - looked_at(prepared, buckets)
        if spared >= 0.5:
            why = f"beyond {prepared.radius.max():.3g} m of where features point densities are below eps of the rest"
            found.append(Omission("far landmarks", why, f"about {share(spared, count)} of {count} landmarks"))
    return found
