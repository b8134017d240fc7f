"""Structs: numbers that travel together from the host to kernels, declared once for all languages.

A field is an ``int``, a ``real`` of the model's precision or a ``double``. OpenCL's declarations are written from the
annotations, Warp's structs are made from them, and the NumPy reference takes the tuples themselves.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple, TypeAlias

import numpy as np

real: TypeAlias = float
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


class Cone(NamedTuple):
    """Number of rays of a sensor's cone, and the least cosine of an angle of incidence with a return."""

    rays: int
    critical: real


class MixtureTables(NamedTuple):
    """Bins of the angle of incidence, each with separate terms, and the cells of a table of log densities."""

    incidence_bins: int
    cells: int
    per_metre: real


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
    each: int
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
    """Companions of a scan's rays in a part of the map, and rules for its readings; see the kernel file ``passages``.

    The part begins at the column ``left`` and the row ``top`` of the map. Companions start at the offset ``beside``
    from the beam, or at the position's deviation up to ``most_beside`` [m]. They diverge by ``apart``, or by the
    deviation of the heading up to ``most_apart``, and by ``cone`` [rad]. Tolerances of readings are ``part`` of them,
    at least ``least`` and the deviation of the position; rays are walked up to ``limit`` [m]. Walls have the value
    ``occupied`` or more.
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
    left: int
    top: int


STRUCTS: dict[str, type[tuple[Any, ...]]] = {
    struct.__name__: struct
    for struct in (
        Window, Frame, Caster, RangeScale, Cone, MixtureTables, Score, ScanBatch, ReadingRules, Buckets, SensorView,
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
