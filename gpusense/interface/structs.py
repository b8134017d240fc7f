"""Structs: numbers that travel together from the host to kernels, declared once for all languages.

A field is an ``int``, a ``real`` of the model's precision or a ``double``. OpenCL's declarations are written from the
annotations, Warp's structs are made from them, and the NumPy reference takes the tuples themselves. A buffer may hold
an array of structs whose fields are all ``real``; the NumPy reference sees one tuple of arrays.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

# A number, or in the NumPy reference an array of numbers.
real: TypeAlias = Any
double: TypeAlias = float

_INT, _DOUBLE = np.dtype(np.int32), np.dtype(np.float64)


class Window(NamedTuple):
    """A part of a grid: its first row and column, and its size."""

    row: int
    col: int
    rows: int
    cols: int


class Frame(NamedTuple):
    """A grid's frame in the world, with the grid's yaw, and the scanner's position on the robot [m]."""

    origin_x: double
    origin_y: double
    resolution: double
    mount_x: double
    mount_y: double
    yaw_cos: double
    yaw_sin: double


class Caster(NamedTuple):
    """The knobs of all casters; each caster reads its fields."""

    bins: int
    slack: real
    tolerance: real


class RangeScale(NamedTuple):
    """Longest distance to search [cells], size of a cell and largest range [m]."""

    limit: real
    resolution: real
    range_max: real


class Crowd(NamedTuple):
    """Moving shapes of each world, the numbers of all its shapes, and the side of a cell [m]; see ``shapes``.

    ``pairs`` are the pairs of numbers of a sight, ``begin`` is the first pair.
    """

    discs: int
    boxes: int
    segments: int
    stride: int
    side: real
    pairs: int = 0
    begin: int = 0


class Cone(NamedTuple):
    """Number of rays of a sensor's cone, and the least cosine of an angle of incidence with a return."""

    rays: int
    critical: real


class MixtureTables(NamedTuple):
    """Bins of the angle of incidence, each with separate terms, and the cells of a table of log densities."""

    incidence_bins: int
    cells: int
    per_metre: real


class MixtureTerms(NamedTuple):
    """The beam model's mixture for one bin of angles of incidence; see the kernel file ``mixture``.

    ``hit_peak`` is the peak of z_hit p_hit, z_hit / (sigma_hit sqrt(2 pi)) for a normal, and ``rand_density`` is
    z_rand / range_max. The log domain has their logarithms and log z_short. ``z_max`` is log z_max, but z_max itself
    with CUBES. A number named ``*_low`` is the rounding error of the number before the suffix.

    ``square_scale`` is 1 / (2 sigma_hit^2), ``erf_scale`` is 1 / (sigma_hit sqrt 2), and ``relative_growth`` is
    sigma_growth / sigma_hit. The density is constant from the expected range ``max(last_offset + last_slope z,
    last_least)`` on. ``inverse_sigma`` is 1 / sigma_hit, and ``unit_peak`` is sigma_hit times the peak of an
    untruncated hit; only the kernel file ``learning`` reads them. ``mass_table`` is the place of the shape's table in
    ``masses``.
    """

    hit_peak: real
    square_scale: real
    erf_scale: real
    z_short: real
    lambda_short: real
    rand_density: real
    range_max: real
    z_max: real
    hit_peak_low: real
    square_scale_low: real
    range_bias: real
    range_bias_low: real
    relative_growth: real
    relative_growth_low: real
    last_offset: real
    last_slope: real
    last_least: real
    inverse_sigma: real
    unit_peak: real
    shape_power: real
    shape_rate: real
    mass_table: real


class FieldTerms(NamedTuple):
    """The mixture of a likelihood field, with the names of ``MixtureTerms``; see the kernel file ``field_term``."""

    hit_peak: real
    square_scale: real
    rand_density: real
    z_max: real
    hit_peak_low: real
    square_scale_low: real
    shape_power: real
    shape_rate: real


class FeatureTerms(NamedTuple):
    """A landmark sensor; see the kernel file ``landmarks``.

    ``zero_range_density`` is the density of a bearing at zero range, relative to its peak and scale.
    """

    range_max: real
    range_max_low: real
    field_of_view: real
    zero_range_density: real


class PositionTerms(NamedTuple):
    """Density of a measured position: log of the uniform part, factors of the offset's axes, log of the peak."""

    random: real
    x_scale: real
    x_scale_low: real
    shear: real
    shear_low: real
    y_scale: real
    y_scale_low: real
    peak: real
    peak_low: real


class HeadingTerms(NamedTuple):
    """Density of a measured heading; see the kernel file ``absolute``.

    ``scale`` is 1 / (sigma sqrt 2) or sqrt(2 kappa), ``peak`` the log of z_hit times the peak, ``random`` the log of
    the uniform part, and ``decay`` is 2 pi / sigma^2.
    """

    random: real
    decay: real
    scale: real
    scale_low: real
    peak: real
    peak_low: real


class BeaconTerms(NamedTuple):
    """Density of a range to a beacon; see the kernel file ``beacons``.

    ``scale`` is 1 / (sigma sqrt 2), ``peak`` the log of z_hit times the peak, and ``random`` the log of the uniform
    part. The wide normal has ``wide_scale`` and ``wide_peak``. For a Student t with peak P, ``scale`` is 1 / (sigma
    sqrt(nu k)) with k = P^(2 / (nu + 1)), ``peak`` is log z_hit, ``offset`` is 1 / k, ``power`` is (nu + 1) / 2,
    ``t_scale`` is 1 / (sigma sqrt nu), ``arc`` is the factor of the arc, and ``odd`` is 1 for an odd nu.
    """

    random: real
    range_max: real
    scale: real
    scale_low: real
    peak: real
    peak_low: real
    wide_scale: real = 0.0
    wide_scale_low: real = 0.0
    wide_peak: real = 0.0
    wide_peak_low: real = 0.0
    offset: real = 0.0
    offset_low: real = 0.0
    power: real = 0.0
    t_scale: real = 0.0
    arc: real = 0.0
    odd: real = 0.0


class ContactTerms(NamedTuple):
    """Density of a bumper's contacts; see the kernel file ``contact``.

    ``scale`` is 1 / (sigma sqrt 2), ``reach`` the gap of touching centres and ``side`` a cell's side [m].
    ``log_contact`` and ``log_false`` are log p_contact and log p_false, ``log_missed`` and ``log_quiet`` those of 1 -
    p_contact and 1 - p_false.
    """

    scale: real
    scale_low: real
    reach: real
    reach_low: real
    side: real
    side_low: real
    log_contact: real
    log_false: real
    log_missed: real
    log_quiet: real


class Score(NamedTuple):
    """log p = temperature * (constant_term + the sum over readings)."""

    constant_term: real
    temperature: real


class ScanBatch(NamedTuple):
    """Number of particles of each scan, and of earlier launches."""

    per_scan: int
    ahead: int


class ReadingRules(NamedTuple):
    """Rules that select and place readings on the device; see the kernel file ``scan``."""

    nearest: double
    farthest: double
    log_max: double
    top: double
    guard_scale: double
    beams: int
    rays_per_beam: int
    places: int
    chosen: int
    max_readings: int
    possible: int


class Buckets(NamedTuple):
    """Square buckets of landmarks: their rows and columns, and the length of a side [m]."""

    rows: int
    cols: int
    size: real


class SensorView(NamedTuple):
    """Field of view of a landmark sensor, and the log probability that a landmark in it is missed."""

    range_max: real
    axis_cosine: real
    axis_sine: real
    least: real
    log_missed: real


class ScoreTable(NamedTuple):
    """Consecutive tables of one size, each with a margin [cells]; see the kernel file ``search``."""

    tables: int
    rows: int
    cols: int
    margin: int


class MatchRules(NamedTuple):
    """Rules of a scan match; see the kernel file ``icp``. Distances are in metres."""

    iterations: int
    stride: int
    skip: int
    score_stride: int
    thin: int
    one_way: int
    capture: real
    least_capture: real
    scale: real
    least_scale: real
    shrink: real
    gap: real
    near: real
    tolerance: real


class BeamRules(NamedTuple):
    """Companions of a scan's rays, and rules for its readings; see the kernel file ``beam_consistency``.

    Companions start ``beside`` off the beam, or at the position's deviation up to ``most_beside`` [m]. They diverge by
    ``apart``, or by the deviation of the heading up to ``most_apart``, and by ``cone`` [rad]. Tolerances of readings
    are ``part`` of them, at least ``least`` and the deviation of the position; rays are walked up to ``limit`` [m].
    Walls have the value ``occupied`` or more.
    """

    beside: double
    most_beside: double
    apart: double
    most_apart: double
    cone: double
    least: double
    part: double
    limit: double
    range_max: double
    occupied: int


STRUCTS: dict[str, type[tuple[Any, ...]]] = {
    struct.__name__: struct
    for struct in (
        Window, Frame, Caster, RangeScale, Crowd, Cone, MixtureTables, MixtureTerms, FieldTerms, FeatureTerms,
        PositionTerms, HeadingTerms, BeaconTerms, ContactTerms, Score, ScanBatch, ReadingRules, Buckets, SensorView,
        ScoreTable, MatchRules, BeamRules,
    )
}  # fmt: skip


def fields(struct: str) -> dict[str, str]:
    """Return the types of a struct's fields, ``int``, ``real`` or ``double``, by name."""
    # NamedTuple turns string annotations into forward references.
    kinds = STRUCTS[struct].__annotations__.items()
    return {name: str(getattr(kind, "__forward_arg__", kind)) for name, kind in kinds}


@functools.cache
def dtypes(struct: str, precision: np.dtype) -> tuple[np.dtype, ...]:
    """Return the NumPy types of a struct's fields in a precision."""
    known: dict[str, np.dtype] = {"int": _INT, "real": precision, "double": _DOUBLE}
    return tuple([known[kind] for kind in fields(struct).values()])


def rounded(value: tuple[Any, ...], struct: str, precision: np.dtype) -> tuple[Any, ...]:
    """Return a struct with real numbers in a precision, as kernels see them."""
    made: type[Any] = STRUCTS[struct]
    pairs = zip(value, dtypes(struct, precision), strict=True)
    return made(*(int(number) if kind == _INT else kind.type(number) for number, kind in pairs))


def packed(rows: Sequence[tuple[Any, ...]], precision: np.dtype) -> np.ndarray:
    """Return structs of real numbers as one array, for a buffer that a kernel reads as an array of structs."""
    return np.array(rows, precision).ravel()


def columns(struct: str, numbers: np.ndarray) -> Any:
    """Return an array of structs of real numbers as one struct whose fields are arrays with a number of each."""
    made: type[Any] = STRUCTS[struct]
    count = len(made._fields)
    return made(*numbers[: numbers.size // count * count].reshape(-1, count).T)


def declaration(struct: str) -> str:
    """Return a struct's declaration in OpenCL C, in one line."""
    members = " ".join(f"{kind} {name};" for name, kind in fields(struct).items())
    return f"typedef struct {{ {members} }} {struct};\n"


@functools.cache
def layout(struct: str, precision: np.dtype) -> str:
    """Return the format of ``struct.pack`` with the layout of C compilers: aligned, and padded at the end."""
    types = dtypes(struct, precision)
    widest = max(types, key=lambda kind: kind.itemsize)
    return "@" + "".join(kind.char for kind in types) + f"0{widest.char}"
