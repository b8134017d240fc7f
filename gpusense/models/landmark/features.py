"""Features for a device: checks, and the numbers of the kernels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gpusense._util import checks
from gpusense.backends import Backend
from gpusense.backends.base import Buffer
from gpusense.interface import feature_layout as at
from gpusense.interface.constants import log_weight
from gpusense.interface.feature_layout import ARCS
from gpusense.interface.structs import FeatureTerms, packed
from gpusense.world.frames import Mount, split
from gpusense.world.landmarks import Buckets, LandmarkMap
from gpusense.world.parameters import LandmarkParameters
from gpusense.world.plausible import look_at_bearings

# Discs are widened by this share, for rounding errors of distances.
_WIDER = 1e-5
# Columns of low parts, and the columns that they belong to, of lines as well, and of landmarks.
LOW_PARTS = (
    (at.RANGE_LOW, at.RANGE_AT), (at.COSINE_LOW, at.COSINE), (at.SINE_LOW, at.SINE),
    (at.SIGNATURE_LOW, at.SIGNATURE_AT), (at.RANGE_SCALE_LOW, at.RANGE_SCALE),
    (at.BEARING_SCALE_LOW, at.BEARING_SCALE), (at.SIGNATURE_SCALE_LOW, at.SIGNATURE_SCALE), (at.PEAK_LOW, at.PEAK),
)  # fmt: skip
_LOW_PARTS = (*LOW_PARTS, (at.UPPER_LOW, at.UPPER))


def read_table(features: object, columns: Sequence[int]) -> np.ndarray:
    """Return features of one of some numbers of columns, as (F, largest number) float64 with NaN in further columns."""
    values = checks.as_array("features", features, masked=True)
    values = np.zeros((0, columns[0])) if values.shape == (0,) else checks.array("features", values, finite=False)
    if values.ndim != 2 or values.shape[1] not in columns:
        *first, last = (f"(F, {count})" for count in columns)
        got = checks.shape_text(values.shape)
        raise ValueError(f"features: shape must be {', '.join(first)} or {last}, got {got}")
    full = np.full((len(values), columns[-1]), np.nan)
    full[:, : values.shape[1]] = values
    return full


def _read(features: object, p: LandmarkParameters) -> np.ndarray:
    """Return (F, 3) float64 features, NaN for parts not measured or left out; finite bearings are in [-pi, pi]."""
    full = read_table(features, (2, 3))
    full[:, [sigma is None for sigma in (p.sigma_range, p.sigma_bearing, p.sigma_signature)]] = np.nan
    finite = np.isfinite(full[:, 1])
    full[finite, 1] = wrapped(full[finite, 1])
    return full


def look_at_feature_angles(features: object, column: int, name: str) -> bool:
    """Warn of implausible angles in a column of features; return whether there were any."""
    values = np.asarray(features, np.float64)
    angles = values[:, column][np.isfinite(values[:, column])] if values.ndim == 2 else np.zeros(0)
    look_at_bearings(name, angles)
    return bool(angles.size)


def _impossible(full: np.ndarray, p: LandmarkParameters, span: tuple[float, float]) -> np.ndarray:
    """Return (F, 3) whether a part is outside the sensor's limits."""
    half = math.inf if full_circle(p) else p.field_of_view / 2
    low, high = np.array([0.0, -half, span[0]]), np.array([p.range_max, half, span[1]])
    bad: np.ndarray = (full < low) | (full > high) | np.isinf(full)
    return bad


def possible_features(
    features: object, p: LandmarkParameters, span: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Return (F, 3) features, all NaN where a part is impossible, and (F,) whether a feature is impossible."""
    full = _read(features, p)
    bad = np.asarray(_impossible(full, p, span).any(axis=1))
    full[bad] = np.nan
    return full, bad


def check_features(features: object, p: LandmarkParameters, span: tuple[float, float]) -> np.ndarray:
    """Return (F, 3) float64 features, NaN for parts not measured or left out; bearings are in [-pi, pi]."""
    full = _read(features, p)
    half, rules = p.field_of_view / 2, [f"range must be in [0, {p.range_max:.15g}] (range_max)"]
    if full_circle(p):
        rules.append("bearing must be finite, or NaN where it was not measured")
    else:
        rules.append(f"bearing must be in [-{half:.15g}, {half:.15g}] (field_of_view)")
    rules.append(f"signature must be in [{span[0]:.15g}, {span[1]:.15g}] (signature_span)")
    bad = _impossible(full, p, span)
    for column, rule in enumerate(rules):
        at = np.flatnonzero(bad[:, column])
        if len(at):
            raise ValueError(f"features: {rule}, got {checks.show(float(full[at[0], column]))} at index {at[0]}")
    return full


def wrapped(angle: np.ndarray) -> np.ndarray:
    """Wrap angles to [-pi, pi]; angles in that interval keep their bits."""
    turned = np.arctan2(np.sin(angle), np.cos(angle))
    return np.where(np.abs(angle) <= np.pi, angle, turned)


def check_correspondence(correspondence: object, count: int, landmarks: int) -> np.ndarray:
    """Return the (F,) landmark of each feature, -1 for none."""
    return checks.indices("correspondence", correspondence, landmarks, (count,), low=-1)


def _disc_of(
    p: LandmarkParameters, sensor: Sensor, z: float, measured: np.ndarray, bound: float
) -> tuple[float, float, float]:
    """Return the disc outside which exponents are larger than ``bound``; ``z``: the range, where it was measured.

    Returns:
        Distance of its centre along the bearing; its radius, negative where no landmark matters; and the least distance
        from the sensor [m].
    """
    if bound < 0:
        return 0.0, -1.0, 0.0
    wide = math.sqrt(bound)
    near, far = 0.0, p.range_max
    if measured[0]:
        near, far = max(z - wide / sensor.scales[0], 0.0), z + wide / sensor.scales[0]
    elif not measured[1]:
        return 0.0, far, 0.0
    angle = min(wide / sensor.scales[1], math.pi) if measured[1] else math.pi
    around = 0.0, far, near
    if not measured[1]:
        return around
    if math.isinf(far):
        # All landmarks may matter until one is likelier than every landmark beyond some distance.
        return z, far, 0.0
    # A corner is the point of a ring's sector farthest from its middle.
    if measured[0]:
        ahead = z
    else:
        ahead = far / (2 * math.cos(angle)) if angle <= math.pi / 4 else far * math.cos(min(angle, math.pi / 2))
    cosine = math.cos(angle)
    radius = math.sqrt(max(max(ahead**2 + d**2 - 2 * ahead * d * cosine for d in (near, far)), 0.0))
    if not measured[0]:
        radius = max(radius, abs(far - ahead))
    return (ahead, radius, near) if radius < far else around


@dataclass(frozen=True)
class PreparedFeatures:
    """Features as kernels take them."""

    columns: np.ndarray  # (K,) positions of the features that are evaluated
    numbers: np.ndarray  # (K, FEATURE) in the model's precision; see ``gpusense.reference.landmarks``
    measured: np.ndarray  # (K, 3) whether range, bearing and signature were measured
    false: np.ndarray  # (F,) float64 log densities of each feature as a false positive; 0 where nothing was measured

    def chosen(self, which: np.ndarray) -> PreparedFeatures:
        """Return the evaluated features that a mask (K,) selects."""
        return replace(self, **{name: getattr(self, name)[which] for name in ("columns", "numbers", "measured")})

    @property
    def radius(self) -> np.ndarray:
        """The (K,) radius of each feature's disc [m]; negative where no landmark matters."""
        return self.numbers[:, at.RADIUS]


def prepare_features(
    features: np.ndarray,
    p: LandmarkParameters,
    sensor: Sensor,
    mount: Mount,
    real: np.dtype,
    *,
    extent: float,
    norm: float,
    gated: bool,
) -> PreparedFeatures:
    """Return the numbers of (F, 3) features, NaN where not measured.

    ``extent``: largest coordinate of the landmarks in their buckets' frame [m]; ``gated``: whether to bound the discs.
    """
    is_measured = ~np.isnan(features)
    informative = is_measured.any(axis=1)
    false = np.where(informative, log_weight(p.z_false) + (is_measured * sensor.uniforms).sum(axis=1), 0.0)
    columns = np.flatnonzero(informative)
    numbers = np.zeros((len(columns), at.FEATURE))
    measured, kept = is_measured[columns], features[columns]
    values = np.where(measured, kept, 0.0)
    bearing = values[:, 1] + mount[2]
    scales = measured * np.array(sensor.scales)
    peak = log_weight(p.z_detect) + (measured * sensor.peaks).sum(axis=1)
    if full_circle(p):
        peak = peak - measured[:, 1] * sensor.least_masses[1]
    numbers[:, [at.RANGE_AT, at.SIGNATURE_AT]] = values[:, [0, 2]]
    numbers[:, at.COSINE], numbers[:, at.SINE] = np.cos(bearing), np.sin(bearing)
    numbers[:, [at.RANGE_SCALE, at.BEARING_SCALE, at.SIGNATURE_SCALE]] = scales
    numbers[:, at.PEAK], numbers[:, at.FALSE_POSITIVE] = peak, false[columns]
    numbers[:, at.UPPER] = p.field_of_view / 2 - values[:, 1]
    numbers[:, at.FARTHEST] = np.where(measured[:, 0], np.inf, p.range_max)
    limited = ~measured[:, 1] & (not full_circle(p))
    numbers[:, at.AXIS] = np.where(limited, math.cos(p.field_of_view / 2), -2.0)
    least = np.array(sensor.least_masses) * (1.0, not full_circle(p), 0.0)
    highest = peak - (measured * least).sum(axis=1) + measured[:, 2] * norm
    with np.errstate(divide="ignore"):
        numbers[:, at.RANGE_SPREAD], numbers[:, at.BEARING_SPREAD] = 1 / scales[:, 0], 1 / scales[:, 1]
    numbers[:, at.MOST] = highest
    eps = np.finfo(real).eps
    bounds = np.full(len(columns), np.inf)
    if gated:
        # A landmark below this adds less than eps to the density of a false positive.
        smallest = false[columns] + math.log(eps) - 1
        with np.errstate(invalid="ignore"):
            bounds = np.where(np.isneginf(highest), -np.inf, highest - smallest)
    _set_reaches(numbers, p, sensor, values[:, 0], measured, bounds, 16 * eps * (extent + 2 * p.range_max))
    return PreparedFeatures(columns, in_two_parts(numbers, real, _LOW_PARTS), measured, false)


def _set_reaches(
    numbers: np.ndarray, p: LandmarkParameters, sensor: Sensor, distances: np.ndarray, measured: np.ndarray,
    bounds: np.ndarray, slack: float,
) -> None:  # fmt: skip
    """Set the discs in which landmarks matter, wider by the rounding error ``slack`` of a distance [m].

    ``bounds``: (K,) largest differences of a landmark's log density from the highest one.
    """
    # (d + slack)^2 <= 1.01 d^2 + 101 slack^2, and kernels look for 1.01 d^2.
    numbers[:, at.SLACK] = 101 * slack**2
    for row, distance, known, bound in zip(numbers, distances.tolist(), measured, bounds.tolist(), strict=True):
        reach, radius, hole = _disc_of(p, sensor, distance, known, bound)
        radius = radius if radius < 0 else radius * (1 + _WIDER) + slack
        row[at.REACH : at.HOLE + 1] = reach, radius, max(hole * (1 - _WIDER) - slack, 0.0)


def in_two_parts(numbers: np.ndarray, real: np.dtype, low_parts: Sequence[tuple[int, int]]) -> np.ndarray:
    """Round (K, FEATURE) numbers; ``low_parts`` pairs a column for rounding errors with the rounded column."""
    with np.errstate(invalid="ignore", over="ignore"):
        high, rest = split(numbers, real)
        low = np.where(np.isfinite(numbers), rest, 0).astype(real)
    for column, of in low_parts:
        high[:, column] = low[:, of]
    return high


# ---- a map of landmarks on a device: positions in buckets, signatures, and the numbers of the sensor


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

    # All of range, bearing and signature: 1 / (sigma sqrt 2), 0 for a part that is left out.
    scales: tuple[float, ...]
    peaks: tuple[float, ...]  # logarithms of the largest densities, before the mass is divided out
    least_masses: tuple[float, ...]  # logarithms of the least mass, including a bearing's on a full circle
    uniforms: tuple[float, ...]  # logarithms of the uniform densities
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
    return Sensor(scales, peaks, least, uniforms, span)


def full_circle(p: LandmarkParameters) -> bool:
    """Return whether the field of view is a full circle."""
    return p.field_of_view >= 2 * math.pi
