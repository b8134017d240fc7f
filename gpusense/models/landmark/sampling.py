"""Features and lines that a sensor reports, drawn on the host; see ``gpusense.models.point.sampling``."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from gpusense._util.typing import Floats
from gpusense.models.landmark.features import wrapped as within_half_turn
from gpusense.models.point.sampling import (
    LANDMARKS,
    LINES,
    Draws,
    mounted,
    normal_within,
    standard_normal,
    wrapped,
    wrapped_normal_within,
)
from gpusense.reference.landmarks import ZERO_RANGE
from gpusense.world.frames import Mount
from gpusense.world.landmarks import LandmarkMap, LineMap
from gpusense.world.parameters import LandmarkParameters
from gpusense.world.sensor_parameters import LineParameters

Span = tuple[float, float]


def draw_features(
    draws: Draws, partners: NDArray[np.int64], landmarks: LandmarkMap, p: LandmarkParameters, span: Span, mount: Mount,
    *, every: bool,
) -> Floats:  # fmt: skip
    """Return features of the landmarks ``partners`` (F,), -1 for a false positive; ``every``: also out of view."""
    place, turned = _sensors(draws, mount)
    measured = [sigma is not None for sigma in (p.sigma_range, p.sigma_bearing, p.sigma_signature)]

    def false(u: Floats, v: Floats, w: Floats, _: Floats) -> Floats:
        return _parts(u * p.range_max, (v - 0.5) * p.field_of_view, span[0] + w * (span[1] - span[0]), measured)

    def true(j: int, u: Floats, v: Floats, w: Floats, _: Floats) -> tuple[Floats, NDArray[np.bool]]:
        dx, dy = (landmarks.xy[j] - place).T
        distance, bearing = np.hypot(dx, dy), wrapped(np.arctan2(dy, dx) - turned)
        signature = np.nan if landmarks.signatures is None else float(landmarks.signatures[j])
        seen = (distance <= p.range_max) & (np.abs(bearing) <= p.field_of_view / 2)
        return _parts(*_detections(u, v, w, distance, bearing, signature, p, span), measured), seen

    return _drawn(draws, LANDMARKS, partners, p, measured, false, true, every=every)[..., : 2 + measured[2]]


def _sensors(draws: Draws, mount: Mount) -> tuple[Floats, Floats]:
    """Return the (N, 2) positions of the sensor, and its headings, each within a turn."""
    return mounted(draws.poses, mount), wrapped(draws.poses[:, 2]) + wrapped(np.array([mount[2]]))


def _drawn(
    draws: Draws, stream: int, partners: NDArray[np.int64], p: LandmarkParameters | LineParameters,
    measured: Sequence[bool], false: Callable[..., Floats], true: Callable[..., tuple[Floats, NDArray[np.bool]]], *,
    every: bool,
) -> Floats:  # fmt: skip
    """Return (N, F, columns) features.

    ``false`` and ``true`` draw a false positive, and the feature of a landmark and whether it is in view, from four
    numbers in (0, 1). A feature with an unobservable ``measured`` part is not reported.
    """
    features = np.full((len(draws.poses), len(partners), len(measured)), np.nan)
    for f, j in enumerate(partners.tolist()):
        (kind, detected), (u, v), (w, x) = (draws.uniform(stream + f, call) for call in range(3))
        drawn = false(u, v, w, x)
        if j >= 0:
            feature, seen = true(j, u, v, w, x)
            drawn = np.where((kind * (p.z_detect + p.z_false) < p.z_detect)[:, None], feature, drawn)
            if not every:
                drawn[~(seen & (detected < p.p_detect))] = np.nan
        drawn[np.isnan(drawn[:, measured]).any(axis=1)] = np.nan
        features[:, f] = drawn
    return draws.reshaped(features)


def _detections(
    u: Floats, v: Floats, w: Floats, distance: Floats, bearing: Floats, signature: float, p: LandmarkParameters,
    span: Span,
) -> tuple[Floats, Floats, Floats]:  # fmt: skip
    """Return range, bearing and signature of a landmark, NaN for parts without a deviation and for unobserved ones."""
    r = b = s = np.full_like(u, np.nan)
    if p.sigma_range is not None:
        r = normal_within(u, distance, p.sigma_range, 0.0, p.range_max)
    if p.sigma_bearing is not None:
        half = min(p.field_of_view / 2, np.pi)
        b = wrapped_normal_within(v, bearing, p.sigma_bearing, half)
        # A landmark at the sensor has no bearing.
        b = np.where(distance > ZERO_RANGE, b, (2 * v - 1) * half)
    if p.sigma_signature is not None and not np.isnan(signature):
        s = normal_within(w, np.full_like(u, signature), p.sigma_signature, *span)
    return r, b, s


def _parts(r: Floats, b: Floats, s: Floats, measured: Sequence[bool]) -> Floats:
    """Return (N, 3) features, NaN in parts without a deviation."""
    return np.where(measured, np.stack([r, b, s], axis=1), np.nan)


def draw_lines(
    draws: Draws, partners: NDArray[np.int64], lines: LineMap, p: LineParameters, mount: Mount, *, every: bool
) -> Floats:
    """Return (N, F, 4) features of the lines ``partners`` (F,), -1 for a false positive; NaN for lines out of view.

    ``every``: whether every line is detected, also from behind.
    """
    (place, turned), normals = _sensors(draws, mount), lines.normals

    def true(j: int, u: Floats, v: Floats, *_: Floats) -> tuple[Floats, NDArray[np.bool]]:
        line, seen = _seen(place, turned, lines.segments[j], normals[j], bool(lines.two_sided[j]), p)
        line[:, :2] += _errors(u, v, line, p)
        line[:, 0] = within_half_turn(line[:, 0])
        return line, seen

    return _drawn(draws, LINES, partners, p, [True] * 4, functools.partial(_false_lines, p), true, every=every)


def _false_lines(p: LineParameters, u: Floats, v: Floats, w: Floats, x: Floats) -> Floats:
    """Return (N, 4) lines uniform in angle and distance, with ends within range_max."""
    ends = np.sort((2 * np.stack([w, x]) - 1) * p.range_max, axis=0)
    return np.column_stack([np.pi * (2 * u - 1), v * p.range_max, *ends])


def _seen(
    place: Floats, turned: Floats, segment: Floats, normal: Floats, two_sided: bool, p: LineParameters
) -> tuple[Floats, NDArray[np.bool]]:
    """Return (N, 4) noise-free features of a map line at each pose, and whether part of the line is in view."""
    off = segment.reshape(2, 2) - place[:, None]
    distance = off[:, 0] @ normal
    sign = np.where(two_sided & (distance < 0), -1.0, 1.0)
    along = np.sort(sign[:, None] * (off @ np.array([-normal[1], normal[0]])), axis=1)
    distance = sign * distance
    near = np.minimum(distance, 2 * p.range_max)
    half = np.sqrt(np.maximum(p.range_max**2 - near**2, 0.0))[:, None]
    inside = np.clip(along, -half, half)
    seen = (distance >= 0) & (distance <= p.range_max) & (inside[:, 1] > inside[:, 0])
    angle = np.arctan2(sign * normal[1], sign * normal[0]) - turned
    return np.column_stack([angle, distance, np.where(seen[:, None], inside, along)]), seen


def _errors(u: Floats, v: Floats, line: Floats, p: LineParameters) -> Floats:
    """Return (N, 2) errors of angle and distance: of the distance within its limits, of the angle given that."""
    lever = 0.5 * (line[:, 2] + line[:, 3])
    spread = np.hypot(p.sigma_distance, lever * p.sigma_angle)
    off = normal_within(u, line[:, 1], spread, 0.0, p.range_max) - line[:, 1]
    mean = lever * (p.sigma_angle / spread) ** 2 * off
    return np.column_stack([mean + p.sigma_angle * p.sigma_distance / spread * standard_normal(v), off])
