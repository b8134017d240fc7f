"""Constants of a landmark sensor: scales and masses of its densities, and the limits of its measurements."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gpusense.world.landmarks import LandmarkMap
from gpusense.world.parameters import LandmarkParameters

# Margin of the span of signatures around the map's signatures [sigma].
_SPREAD = 4.0


@dataclass(frozen=True)
class Sensor:
    """Constants of a sensor and its map, in float64."""

    # 1 / (sigma sqrt 2) of range, bearing and signature; 0 for a part that is left out.
    scales: tuple[float, float, float]
    peaks: tuple[float, float, float]  # logarithms of the components' largest densities, before the mass is divided out
    # Logarithms of the least mass of each, including a bearing's on a full circle.
    least_masses: tuple[float, float, float]
    uniforms: tuple[float, float, float]  # logarithms of the uniform densities of range, bearing and signature
    span: tuple[float, float]  # the smallest and largest signature


def span_of(p: LandmarkParameters, landmarks: LandmarkMap) -> tuple[float, float]:
    """Return the smallest and largest signature of a feature."""
    if p.signature_span is not None or p.sigma_signature is None:
        return p.signature_span or (0.0, 1.0)
    signatures = landmarks.signatures if landmarks.signatures is not None and len(landmarks) else np.zeros(1)
    return float(signatures.min()) - _SPREAD * p.sigma_signature, float(signatures.max()) + _SPREAD * p.sigma_signature


def signature_mass(p: LandmarkParameters, landmarks: LandmarkMap) -> np.ndarray:
    """Return the mass of each landmark's signature on the span; signatures are clamped to the span."""
    from scipy.special import erf  # loads SciPy

    if p.sigma_signature is None or landmarks.signatures is None:
        return np.ones(len(landmarks))
    (low, high), scale = span_of(p, landmarks), math.sqrt(0.5) / p.sigma_signature
    clamped = np.clip(landmarks.signatures, low, high)
    mass: np.ndarray = 0.5 * (erf((clamped - low) * scale) + erf((high - clamped) * scale))
    return mass


def describe(p: LandmarkParameters, landmarks: LandmarkMap) -> Sensor:
    """Return the constants of a sensor."""
    span = span_of(p, landmarks)
    lengths = (p.range_max, p.field_of_view, span[1] - span[0])
    deviations = (p.sigma_range, p.sigma_bearing, p.sigma_signature)
    scales = tuple(0.0 if sigma is None else math.sqrt(0.5) / sigma for sigma in deviations)
    peaks = tuple(math.log(scale / math.sqrt(math.pi)) if scale else 0.0 for scale in scales)
    masses = [0.5 * math.erf(min(length, cut) * scale) for length, cut, scale in
              zip(lengths, (math.inf, math.pi, math.inf), scales, strict=True)]  # fmt: skip
    if full_circle(p):
        masses[1] = math.erf(math.pi * scales[1])
    least = tuple(math.log(mass) if mass > 0 else 0.0 for mass in masses)
    uniforms = tuple(-math.log(length) for length in lengths)
    return Sensor(_three(scales), _three(peaks), _three(least), _three(uniforms), span)


def _three(values: tuple[float, ...]) -> tuple[float, float, float]:
    first, second, third = values
    return first, second, third


def full_circle(p: LandmarkParameters) -> bool:
    """Return whether the field of view is a full circle."""
    return p.field_of_view >= 2 * math.pi
