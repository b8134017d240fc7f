"""Features and lines that a sensor reports, drawn on the host; see ``gpusense.models.point.sampling``."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gpusense._util.typing import Floats
from gpusense.models.landmark.features import wrapped
from gpusense.models.point.sampling import (
    LANDMARKS,
    LINES,
    Draws,
    mounted,
    normal_within,
    standard_normal,
    wrapped_normal_within,
)
from gpusense.reference.landmarks import ZERO_RANGE
from gpusense.reference.relative import wrapped_difference
from gpusense.world.landmarks import LandmarkMap, LineMap
from gpusense.world.parameters import LandmarkParameters
from gpusense.world.sensor_parameters import LineParameters

Span = tuple[float, float]


def draw_features(
    draws: Draws,
    partners: NDArray[np.int64],
    landmarks: LandmarkMap,
    p: LandmarkParameters,
    span: Span,
    mount: tuple[float, float, float],
    *,
    every: bool,
) -> Floats:
    """Return features of the landmarks ``partners`` (F,), -1 for a false positive; ``every``: also out of view."""
    columns = 2 if p.sigma_signature is None else 3
    features = np.full((len(draws.poses), len(partners), columns), np.nan)
    place, none = mounted(draws.poses, mount), (np.zeros(1), np.zeros(1))
    turned = wrapped_difference(draws.poses[:, 2], none)[0] + wrapped_difference(np.array([mount[2]]), none)[0]
    for f, j in enumerate(partners.tolist()):
        stream = LANDMARKS + f
        (kind, detected), (u, v) = draws.uniform(stream), draws.uniform(stream, 1)
        w = draws.uniform(stream, 2)[0]
        drawn = _false_positives(u, v, w, p, span)
        if j >= 0:
            dx, dy = (landmarks.xy[j] - place).T
            distance = np.hypot(dx, dy)
            bearing = wrapped_difference(np.arctan2(dy, dx) - turned, none)[0]
            signature = None if landmarks.signatures is None else float(landmarks.signatures[j])
            true = _detections(u, v, w, distance, bearing, signature, p, span)
            drawn = np.where((kind * (p.z_detect + p.z_false) < p.z_detect)[:, None], true, drawn)
            if not every:
                seen = (distance <= p.range_max) & (np.abs(bearing) <= p.field_of_view / 2) & (detected < p.p_detect)
                drawn[~seen] = np.nan
        # A feature with an unobservable measured part is not reported.
        measured = [sigma is not None for sigma in (p.sigma_range, p.sigma_bearing, p.sigma_signature)]
        drawn[np.isnan(drawn[:, measured]).any(axis=1)] = np.nan
        features[:, f] = drawn[:, :columns]
    return draws.reshaped(features)


def _false_positives(u: Floats, v: Floats, w: Floats, p: LandmarkParameters, span: Span) -> Floats:
    """Return (N, 3) features uniform within the sensor's limits, NaN for parts without a deviation."""
    return _parts(u * p.range_max, (v - 0.5) * p.field_of_view, span[0] + w * (span[1] - span[0]), p)


def _detections(
    u: Floats,
    v: Floats,
    w: Floats,
    distance: Floats,
    bearing: Floats,
    signature: float | None,
    p: LandmarkParameters,
    span: Span,
) -> Floats:
    """Return (N, 3) features of a landmark, NaN for parts without a deviation and for unobserved ones."""
    nan = np.full_like(u, np.nan)
    r = nan if p.sigma_range is None else normal_within(u, distance, p.sigma_range, 0.0, p.range_max)
    b = nan
    if p.sigma_bearing is not None:
        half = min(p.field_of_view / 2, np.pi)
        b = wrapped_normal_within(v, bearing, p.sigma_bearing, half)
        # A landmark at the sensor has no bearing.
        b = np.where(distance > ZERO_RANGE, b, (2 * v - 1) * half)
    s = nan
    if p.sigma_signature is not None and signature is not None:
        s = normal_within(w, np.full_like(u, signature), p.sigma_signature, *span)
    return _parts(r, b, s, p)


def _parts(r: Floats, b: Floats, s: Floats, p: LandmarkParameters) -> Floats:
    parts = np.stack([r, b, s], axis=1)
    parts[:, [sigma is None for sigma in (p.sigma_range, p.sigma_bearing, p.sigma_signature)]] = np.nan
    return parts


def draw_lines(
    draws: Draws, partners: NDArray[np.int64], lines: LineMap, p: LineParameters, mount: tuple[float, float, float], *,
    every: bool,
) -> Floats:  # fmt: skip
    """Return (N, F, 4) features of the lines ``partners`` (F,), -1 for a false positive; NaN for lines out of view.

    ``every``: whether every line is detected, also from behind.
    """
    features = np.full((len(draws.poses), len(partners), 4), np.nan)
    place, none = mounted(draws.poses, mount), (np.zeros(1), np.zeros(1))
    turned = wrapped_difference(draws.poses[:, 2], none)[0] + wrapped_difference(np.array([mount[2]]), none)[0]
    normals = lines.normals
    for f, j in enumerate(partners.tolist()):
        stream = LINES + f
        (kind, detected), (u, v) = draws.uniform(stream), draws.uniform(stream, 1)
        ends = draws.uniform(stream, 2)
        drawn = _false_lines(u, v, *ends, p)
        if j >= 0:
            true, seen = _seen(place, turned, lines.segments[j], normals[j], bool(lines.two_sided[j]), p)
            true[:, :2] += _errors(u, v, true, p)
            true[:, 0] = wrapped(true[:, 0])
            drawn = np.where((kind * (p.z_detect + p.z_false) < p.z_detect)[:, None], true, drawn)
            if not every:
                drawn[~(seen & (detected < p.p_detect))] = np.nan
        drawn[np.isnan(drawn).any(axis=1)] = np.nan
        features[:, f] = drawn
    return draws.reshaped(features)


def _false_lines(u: Floats, v: Floats, w: Floats, x: Floats, p: LineParameters) -> Floats:
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
