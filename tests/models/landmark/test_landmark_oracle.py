"""The landmark model against mpmath: known, unknown and joint association, stiff and extreme cases, quadrature."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import mpmath as mp
import numpy as np
import pytest
from support import landmark_scenes as scenes
from support.feature_oracle import Densities, assert_within, joint, likelihoods
from support.selection import on_every_backend

import gpusense as gs
from gpusense.evaluation.tolerances import TOLERANCES
from gpusense.interface import feature_layout as at
from gpusense.world.frames import place_poses

mp.mp.dps = 36


@dataclass(frozen=True)
class Seen:
    """A sensor: position, cosine and sine of its axis's heading, without the mount's yaw."""

    x: Any
    y: Any
    cosine: Any
    sine: Any


def wrap(angle: Any) -> Any:
    """Wrap an angle to (-pi, pi]."""
    return angle - 2 * mp.pi * mp.ceil((angle - mp.pi) / (2 * mp.pi))


def normal(residual: Any, sigma: Any) -> Any:
    return mp.exp(-((residual / sigma) ** 2) / 2) / (sigma * mp.sqrt(2 * mp.pi))


def mass(low: Any, high: Any, sigma: Any) -> Any:
    """Return the mass of a normal around 0 on [low, high]."""
    scale = sigma * mp.sqrt(2)
    return (mp.erf(high / scale) - mp.erf(low / scale)) / 2


def bearing_mass(expected: Any, half: Any, sigma: Any) -> Any:
    """Return the mass of the wrapped difference to a bearing, clamped to [-half, half], over that interval."""
    expected = min(max(expected, -half), half)
    low, high, found = -half - expected, half - expected, mp.mpf(0)
    for turn in (-1, 0, 1):
        # The part of the field with a wrapped difference off by this many turns.
        a, b = max(low + 2 * mp.pi * turn, -mp.pi), min(high + 2 * mp.pi * turn, mp.pi)
        found += mass(a, b, sigma) if b > a else 0
    return found


def span_of(p: gs.LandmarkParameters, signatures: Any) -> tuple[Any, Any]:
    if p.signature_span is not None:
        return tuple(map(mp.mpf, p.signature_span))
    four = 4 * mp.mpf(p.sigma_signature)
    own = [mp.mpf(float(s)) for s in signatures] or [mp.mpf(0)]
    return min(own) - four, max(own) + four


def density(
    p: gs.LandmarkParameters, seen: Seen, landmark: Any, feature: Any, turn: Any, signature: Any, span: Any
) -> Any:
    """Return p(f | j); ``turn`` is the (cosine, sine) of the bearing on the robot."""
    dx, dy = landmark[0] - seen.x, landmark[1] - seen.y
    d, found = mp.sqrt(dx * dx + dy * dy), mp.mpf(1)
    if p.sigma_range is not None and feature[0] is not None:
        sigma, z_max = mp.mpf(p.sigma_range), mp.mpf(p.range_max)
        inside = min(d, z_max)
        found *= normal(feature[0] - d, sigma) / mass(-inside, z_max - inside, sigma)
    if p.sigma_bearing is not None and feature[1] is not None:
        sigma, half = mp.mpf(p.sigma_bearing), mp.mpf(p.field_of_view) / 2
        full = p.field_of_view >= 2 * np.pi
        if d <= 1e-6:
            found /= 2 * half
        else:
            c = seen.cosine * turn[0] - seen.sine * turn[1]
            s = seen.sine * turn[0] + seen.cosine * turn[1]
            angle = mp.atan2(c * dy - s * dx, c * dx + s * dy)
            own = mass(-mp.pi, mp.pi, sigma) if full else bearing_mass(wrap(feature[1] + angle), half, sigma)
            found *= normal(angle, sigma) / own
    if p.sigma_signature is not None and feature[2] is not None:
        sigma = mp.mpf(p.sigma_signature)
        inside = min(max(signature, span[0]), span[1])
        found *= normal(feature[2] - signature, sigma) / mass(span[0] - inside, span[1] - inside, sigma)
    return found


def uniform(p: gs.LandmarkParameters, feature: Any, span: Any) -> Any:
    found = mp.mpf(1)
    if p.sigma_range is not None and feature[0] is not None:
        found /= mp.mpf(p.range_max)
    if p.sigma_bearing is not None and feature[1] is not None:
        found /= mp.mpf(p.field_of_view)
    if p.sigma_signature is not None and feature[2] is not None:
        found /= span[1] - span[0]
    return found


def candidate(p: gs.LandmarkParameters, seen: Seen, landmark: Any, feature: Any, yaw: float) -> bool:
    """Return whether an unknown feature may be a landmark: unmeasured parts are within the sensor's limits."""
    dx, dy = landmark[0] - seen.x, landmark[1] - seen.y
    d = mp.sqrt(dx * dx + dy * dy)
    if (p.sigma_range is None or feature[0] is None) and d > p.range_max:
        return False
    if (p.sigma_bearing is None or feature[1] is None) and p.field_of_view < 2 * np.pi:
        c = seen.cosine * mp.cos(yaw) - seen.sine * mp.sin(yaw)
        s = seen.sine * mp.cos(yaw) + seen.cosine * mp.sin(yaw)
        return bool(c * dx + s * dy >= d * mp.cos(mp.mpf(p.field_of_view) / 2))
    return True


@dataclass(frozen=True)
class World:
    """Sensors, landmarks, features and their turns as exact numbers."""

    seen: list[Seen]
    landmarks: list[Any]
    signatures: list[Any]
    features: list[Any]
    turns: list[Any]


def exact_inputs(model: gs.LandmarkModel, poses: Any, features: Any, *, rounded: bool = True) -> World:
    """Return a call's inputs of the kernels, or the caller's with rounded=False."""
    lm, yaw = model.landmarks, model.mount[2]
    given = np.full((len(features), 3), np.nan)
    given[:, : np.shape(features)[1]] = features
    exact = [[None if np.isnan(v) else mp.mpf(float(v)) for v in row] for row in given]
    signatures = [mp.mpf(float(s)) for s in (lm.signatures if lm.signatures is not None else np.zeros(len(lm)))]
    if not rounded:
        seen = []
        for x, y, theta in np.asarray(poses, float):
            c, s = mp.cos(mp.mpf(theta)), mp.sin(mp.mpf(theta))
            mx, my = (mp.mpf(v) for v in model.mount[:2])
            seen.append(Seen(mp.mpf(x) + c * mx - s * my, mp.mpf(y) + s * mx + c * my, c, s))
        turns = [(mp.cos(f[1] + yaw), mp.sin(f[1] + yaw)) if f[1] is not None else (1, 0) for f in exact]
        return World(seen, [[mp.mpf(v) for v in row] for row in lm.xy.tolist()], signatures, exact, turns)
    b, real = model._buckets, model._real
    placed = place_poses(np.asarray(poses, float), b, model.mount, real)
    seen = []
    for cell, pose, low in zip(placed.cell.tolist(), placed.pose.tolist(), placed.low.tolist(), strict=True):
        both = [mp.mpf(p) + mp.mpf(q) for p, q in zip(pose, low, strict=True)]
        seen.append(Seen(b.resolution * (cell[0] + both[0]), b.resolution * (cell[1] + both[1]), both[2], both[3]))
    table = [[mp.mpf(v) for v in row] for row in b.table(real).tolist()]
    places = [[table[j][0] + table[j][2], table[j][1] + table[j][3]] for j in b.place_of]
    numbers = prepared(model, features)
    turns = [
        (mp.mpf(float(n[at.COSINE])) + mp.mpf(float(n[at.COSINE_LOW])),
         mp.mpf(float(n[at.SINE])) + mp.mpf(float(n[at.SINE_LOW])))
        for n in numbers
    ]  # fmt: skip
    return World(seen, places, signatures, exact, turns)


def prepared(model: gs.LandmarkModel, features: Any) -> np.ndarray:
    """Return the features as numbers; all of them carry information."""
    from gpusense.models.landmark.features import check_features, prepare_features

    p, sensor = model.parameters, model._sensor
    given = check_features(features, p, sensor.span)
    found = prepare_features(given, p, sensor, model.mount, model._real, extent=1.0, norm=0.0, gated=False)
    assert len(found.columns) == len(features)
    return found.numbers


def table(model: gs.LandmarkModel, world: World) -> tuple[Densities, list[Any]]:
    """Return (N, F, M) densities p(f | j), None where j is no candidate, and (F,) densities of false positives."""
    p = model.parameters
    span = span_of(p, model.landmarks.signatures) if p.sigma_signature is not None else (0, 1)
    densities = [
        [
            [
                (density(p, s, xy, f, t, sign, span), candidate(p, s, xy, f, model.mount[2]))
                for xy, sign in zip(world.landmarks, world.signatures, strict=True)
            ]
            for f, t in zip(world.features, world.turns, strict=True)
        ]
        for s in world.seen
    ]
    return densities, [uniform(p, f, span) for f in world.features]


PRECISIONS = ("float32", "float64")
KNOWN = (0, 2, -1, 5, 6)


@functools.cache
def tabled(name: str, precision: str) -> tuple[Densities, list[Any]]:
    """Return the densities of a scene in mpmath, for the kernels' inputs."""
    model, poses, features = scenes.model(name, "numpy", precision=precision)
    return table(model, exact_inputs(model, poses, features))


@functools.cache
def truth(name: str, precision: str, how: str) -> np.ndarray:
    """Return (N, F) log p of a scene's features in mpmath, or (N,) of their joint association."""
    model, _, _ = scenes.model(name, "numpy", association="nearest" if how == "known" else how)
    densities, false = tabled(name, precision)
    if how == "joint":
        return joint(model, densities, false)
    return likelihoods(model, densities, false, KNOWN if how == "known" else None)


def scored(name: str, backend: str, precision: str, how: str) -> tuple[np.ndarray, np.ndarray]:
    """Return (N,) log p of a scene and (N, F) parts of it."""
    if how == "known":
        model, poses, features = scenes.model(name, backend, precision=precision)
        return model.log_likelihood(poses, features, KNOWN), model._evaluate(poses, features, KNOWN, each=True)[2]
    model, poses, features = scenes.model(name, backend, precision=precision, association=how)
    return model.log_likelihood(poses, features), model.associate(poses, features)[1]


@pytest.mark.long_on("warp")
@pytest.mark.sampled(0.25)
@on_every_backend(
    on_warp=lambda name, precision, how: name == "everything" and (precision, how) != ("float64", "sum"),
    name=scenes.SCENES,
    precision=PRECISIONS,
    how=("nearest", "sum", "known"),
)
def test_features_against_mpmath(backend, name, precision, how):
    expected = truth(name, precision, how)
    log_p, parts = scored(name, backend, precision, how)
    assert_within(parts if how != "known" else parts[:, [0, 1, 3, 4]],
                  expected if how != "known" else expected[:, [0, 1, 3, 4]])  # fmt: skip
    # The sum's terms may cancel: the terms bound its error.
    eps = np.finfo(precision).eps
    possible = np.isfinite(expected).all(axis=1)
    assert not np.isnan(log_p).any()
    np.testing.assert_array_equal(np.isfinite(log_p), possible)
    total, size = expected[possible].sum(axis=1), (1 + np.abs(expected[possible])).sum(axis=1)
    assert (np.abs(log_p[possible].astype(np.float64) - total) <= TOLERANCES["landmark"].value * eps * size).all()


@pytest.mark.long
@pytest.mark.sampled(0.4)
@on_every_backend(
    on_warp=lambda name, precision: (name, precision) == ("everything", "float32"),
    name=("ordinary", "everything", "no false positives"),
    precision=PRECISIONS,
)
def test_joint_association_tries_all(backend, name, precision):
    model, poses, features = scenes.model(name, backend, precision=precision, association="joint")
    expected = truth(name, precision, "joint")
    assert_within(model.log_likelihood(poses, features), expected, terms=len(features))
    which, parts = model.associate(poses, features)
    possible = np.isfinite(expected)
    for own in which[possible]:
        chosen = own[own >= 0]
        assert len(np.unique(chosen)) == len(chosen)
    assert_within(parts[possible].sum(axis=1, dtype=parts.dtype), expected[possible], terms=len(features))


@pytest.mark.long_on("warp")
@on_every_backend(on_warp=lambda precision: precision == "float32", precision=PRECISIONS)
def test_features_as_the_caller_gave_them(backend, precision):
    """The bound includes rounding of positions, directions and readings: float32 keeps them in two numbers."""
    model, poses, features = scenes.model("everything", backend, precision=precision)
    expected = likelihoods(model, *table(model, exact_inputs(model, poses, features, rounded=False)))
    found = model.associate(poses, features)[1]
    # float64 positions of up to 300 m, rounded by up to 16 eps; deviations are 0.2.
    allowed = (TOLERANCES["landmark"].value + (3e4 if precision == "float64" else 0)) * np.finfo(precision).eps
    assert (np.abs(found.astype(np.float64) - expected) <= allowed * (1 + np.abs(expected))).all()
