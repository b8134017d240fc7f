"""Lines that a scanner reports, drawn on the host; see ``gpusense.models.point.sampling``."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gpusense.models.landmark.features import wrapped
from gpusense.models.point.sampling import LINES, Draws, mounted, normal_within, standard_normal
from gpusense.reference.relative import wrapped_difference
from gpusense.world.line_map import LineMap
from gpusense.world.sensor_parameters import LineParameters

Floats = NDArray[np.float64]


def draw_lines(
    draws: Draws, partners: NDArray[np.int64], lines: LineMap, p: LineParameters, mount: tuple[float, float, float], *,
    every: bool,
) -> Floats:  # fmt: skip
    """Return (N, F, 4) angle, distance and ends of lines at poses, all NaN for lines that are not visible.

    Args:
        draws: Poses and their random numbers.
        partners: (F,) line of each feature, -1 for a false positive.
        lines: The map.
        p: The parameters.
        mount: The sensor's pose on the robot.
        every: Whether every line is detected, also from behind.
    """
    features = np.full((len(draws.poses), len(partners), 4), np.nan)
    place, none = mounted(draws.poses, mount), (np.zeros(1), np.zeros(1))
    turned = wrapped_difference(draws.poses[:, 2], none)[0] + wrapped_difference(np.array([mount[2]]), none)[0]
    normals = lines.normals
    for f, j in enumerate(partners.tolist()):
        stream = LINES + f
        (kind, detected), (u, v) = draws.uniform(stream), draws.uniform(stream, 1)
        ends = draws.uniform(stream, 2)
        drawn = _false_positives(u, v, *ends, p)
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


def _false_positives(u: Floats, v: Floats, w: Floats, x: Floats, p: LineParameters) -> Floats:
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
    half = np.sqrt(np.maximum(p.range_max**2 - distance**2, 0.0))[:, None]
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
