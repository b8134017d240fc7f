"""The landmark model in mpmath, written from its definition: every landmark, no gate, no buckets, no logarithm sums.

``exact_inputs`` takes the kernels' inputs, to judge only their arithmetic and not the rounding of positions.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import mpmath as mp
import numpy as np

import gpusense as gs
from gpusense.interface import feature_layout as at
from gpusense.world.frames import place_poses

mp.mp.dps = 36

Table = tuple[list[Any], list[Any], Any]


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


def log(p: Any) -> float:
    return float(mp.log(p)) if p > 0 else -np.inf


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


def table(model: gs.LandmarkModel, world: World) -> Table:
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
    return densities, [uniform(p, f, span) for f in world.features], span


def likelihoods(model: gs.LandmarkModel, tabled: Table, correspondence: Any = None) -> np.ndarray:
    """Return (N, F) float64 log p of each feature, without joint association."""
    p, (densities, false, _) = model.parameters, tabled
    detect, miss = mp.mpf(p.z_detect), mp.mpf(p.z_false)
    found = np.empty((len(densities), len(false)))
    for n, rows in enumerate(densities):
        for k, row in enumerate(rows):
            if correspondence is not None:
                j = correspondence[k]
                of_landmarks = row[j][0] if j >= 0 else mp.mpf(0)
            else:
                of = [d for d, may in row if may] or [mp.mpf(0)]
                of_landmarks = mp.fsum(of) / len(row) if model.association == "sum" and row else max(of)
            found[n, k] = log(detect * of_landmarks + miss * false[k])
    return found


def joint(model: gs.LandmarkModel, tabled: Table) -> np.ndarray:
    """Return (N,) float64 log p of the likeliest joint association, by trying all."""
    p, (densities, false, _) = model.parameters, tabled
    detect, miss = mp.mpf(p.z_detect), mp.mpf(p.z_false)
    found = np.full(len(densities), -np.inf)
    for n, rows in enumerate(densities):
        # Terms of each feature: as a false positive, and as each possible landmark.
        options = [
            [(-1, log(miss * none))] + [(j, log(detect * d + miss * none)) for j, (d, may) in enumerate(row) if may]
            for row, none in zip(rows, false, strict=True)
        ]
        for chosen in itertools.product(*options):
            landmarks = [j for j, _ in chosen if j >= 0]
            if len(set(landmarks)) == len(landmarks):
                found[n] = max(found[n], sum(value for _, value in chosen))
    return found
