"""A map of landmarks on a device: positions in buckets, signatures, and the numbers of the sensor."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gpusense.backends import Backend
from gpusense.backends.base import Buffer
from gpusense.interface.feature_layout import ARCS
from gpusense.interface.structs import FeatureTerms, packed
from gpusense.models.landmark.sensor import Sensor, full_circle, signature_mass
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
