"""A map of landmarks on a device: positions in buckets, signatures, and the numbers of the sensor."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gpusense.backends import Backend
from gpusense.backends.base import Buffer
from gpusense.interface.feature_layout import ARCS
from gpusense.interface.structs import FeatureTerms, packed
from gpusense.world.frames import split
from gpusense.world.landmarks import Buckets, LandmarkMap
from gpusense.world.parameters import LandmarkParameters


@dataclass(frozen=True)
class LandmarkTables:
    """Buffers by the names of the kernels' arguments."""

    landmark: Buffer  # (M,) real4 positions in the buckets' frame, by place, and their rounding errors (low parts)
    normal: Buffer  # (M,) real4 normals of lines, x and y, each with its rounding error; one number for landmarks
    # (M,) real4 signatures, their rounding errors (low parts), and -log of their mass on the span; for lines half
    # their length, and 1 if they are seen from both sides.
    signature: Buffer
    start: Buffer  # (rows * columns + 1,) place of the first landmark of each bucket
    terms: Buffer  # the sensor's numbers
    arcs: Buffer  # arcs of the slopes i / 8
    norm: float  # the largest -log of a signature's mass


def upload_tables(
    backend: Backend, real: np.dtype, landmarks: LandmarkMap, buckets: Buckets, p: LandmarkParameters, sensor: Sensor
) -> LandmarkTables:
    """Upload the tables in a precision."""
    signature = np.zeros((len(landmarks), 4))
    if landmarks.signatures is not None:
        high, low = split(landmarks.signatures[buckets.index], real)
        with np.errstate(divide="ignore"):
            norm = -np.log(signature_mass(p, landmarks)[buckets.index])
        signature[:, 0], signature[:, 1], signature[:, 2] = high, low, norm
    high, low = split(np.array([p.range_max, p.field_of_view]), real)
    # The density of a bearing at zero range over the largest one at other ranges, without the scale.
    scale = sensor.scales[1]
    flat = p.field_of_view / math.sqrt(math.pi)
    flat /= math.erf(math.pi * scale) if full_circle(p) and scale else 1.0
    terms = FeatureTerms(high[0], low[0], high[1], flat)
    norm = float(signature[:, 2].max(initial=0.0))
    return uploaded(backend, real, buckets, np.zeros((1, 4)), signature, terms, norm)


def uploaded(
    backend: Backend, real: np.dtype, buckets: Buckets, normal: np.ndarray, signature: np.ndarray, terms: FeatureTerms,
    norm: float = 0.0,
) -> LandmarkTables:  # fmt: skip
    """Upload tables, with the arcs of slopes."""
    arcs = np.empty((len(ARCS), 2), real)
    exact = np.array(ARCS)
    arcs[:, 0] = exact[:, 0]
    arcs[:, 1] = (exact[:, 0] - arcs[:, 0]) + exact[:, 1]

    def upload(table: np.ndarray) -> Buffer:
        return backend.upload(np.ascontiguousarray(table))

    return LandmarkTables(
        upload(buckets.table(real)), upload(normal.astype(real)), upload(signature.astype(real)), upload(buckets.start),
        backend.upload(packed([terms], real)), upload(arcs), norm,
    )  # fmt: skip


# ---- constants of a landmark sensor: scales and masses of its densities, and the limits of its measurements


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
