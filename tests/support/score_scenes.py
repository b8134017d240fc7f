"""Inputs of the kernels of the beam model and the likelihood field: mixtures, scans, tables, tiles and orders."""

from __future__ import annotations

from typing import Any

import numpy as np
from support.kernel_scenes import (
    GRIDS,
    LIMIT,
    RESOLUTION,
    adversarial_poses,
    directions,
    squared_distances,
    window_of,
)

from gpusense.interface.constants import BLOCK_TERMS, TILE, TILE_PARTICLES, rounding_error
from gpusense.interface.structs import FieldTerms, MixtureTerms, packed
from gpusense.models.scan.field_pipeline import _GUARD
from gpusense.world.frames import split

# Weights and shapes of mixtures: z_hit, z_short, z_rand, sigma_hit and lambda_short in metres.
MIXTURES = {
    "book": (0.7, 0.1, 0.1, 0.2, 0.1),
    "hit and rand": (0.9, 0.0, 0.1, 0.05, 0.0),
    "short and rand": (0.0, 0.5, 0.5, 0.2, 1e-12),
    "rand": (0.0, 0.0, 1.0, 0.2, 0.0),
    "steep short": (0.4, 0.4, 0.2, 0.2, 1e6),
    "hit": (1.0, 0.0, 0.0, 0.2, 0.0),
    "narrow hit": (1.0, 0.0, 0.0, 1e-8 * LIMIT * RESOLUTION, 0.0),
    "narrow hit and rand": (0.9, 0.0, 0.1, 1e-6, 0.0),
    "wide hit": (1.0, 0.0, 0.0, 1e6 * LIMIT * RESOLUTION, 0.0),
    "short": (0.0, 1.0, 0.0, 0.2, 0.0),
    "hit and short": (0.5, 0.5, 0.0, 0.2, 3.0),
    "hardly any rand": (0.5, 0.5, 1e-35, 0.2, 0.3),
}


def mixture(name: str, real: type, *, z_max: float) -> tuple[set[str], np.ndarray]:
    """Return flags and terms of the mixture kernels."""
    z_hit, z_short, z_rand, sigma, decay = MIXTURES[name]
    range_max = LIMIT * RESOLUTION
    flags = {flag for flag, z in (("HIT", z_hit), ("SHORT", z_short), ("RAND", z_rand)) if z > 0}
    if len(flags) == 1:
        flags.add("SINGLE")
    head = np.array([z_hit / (sigma * np.sqrt(2 * np.pi)), z_short, z_rand / range_max])
    if head[0] > 64:
        flags.add("EXACT_EXPONENT")
    if head[2] >= (1e-290 if real is np.float64 else 1e-30):
        flags.add("LINEAR")
    else:
        with np.errstate(divide="ignore"):
            head = np.log(head)
    terms = MixtureTerms(**dict.fromkeys(MixtureTerms._fields, 0.0))._replace(
        hit_peak=head[0], square_scale=0.5 / sigma**2, erf_scale=np.sqrt(0.5) / sigma, z_short=head[1],
        lambda_short=decay, rand_density=head[2], range_max=range_max, z_max=np.log(z_max),
    )  # fmt: skip
    return flags, packed_with_low_parts(terms, real)


def packed_with_low_parts(terms: Any, real: type) -> np.ndarray:
    """Return a mixture as kernels read it, with the rounding errors of the peak and scale of a hit."""
    exact = {name: getattr(terms, name) for name in ("hit_peak", "square_scale")}
    low = {f"{name}_low": rounding_error(number, real(number)) for name, number in exact.items()}
    return packed([terms._replace(**low)], np.dtype(real))


def scan(expected: np.ndarray, real: type, *, all_readings: bool) -> np.ndarray:
    """Return readings around one pose's expected ranges: equal to them, 0, next to range_max, and noisy."""
    rng = np.random.default_rng(17)
    range_max = real(LIMIT * RESOLUTION)
    highest = np.nextafter(range_max, real(0))
    reading = np.clip(expected + rng.normal(0, 0.1, expected.shape), 0, highest).astype(real)
    reading[1::7] = np.minimum(expected[1::7], highest)
    reading[2::11], reading[3::13] = 0, highest
    if all_readings:
        reading[4::9], reading[5::9] = np.nan, np.inf
    return reading


# ---- the likelihood field

# Flags, and whether the table holds distances.
FIELDS = {
    "log table": ("LOG_TABLE", "LINEAR", "HIT"),
    "nearest": ("LINEAR", "HIT"),
    "nearest without hit": ("LINEAR",),
    "nearest, hits alone": ("HIT",),
    "bilinear": ("BILINEAR", "LINEAR", "HIT"),
    "bilinear in the log domain": ("BILINEAR", "HIT", "RAND"),
}


def field_scene(name: str, real: type, *, all_readings: bool) -> dict[str, np.ndarray]:
    """Return table, terms, poses and end points; many end points are exactly on edges and corners of cells."""
    occupied = GRIDS["rooms"]
    rng = np.random.default_rng(23)
    z_hit, z_rand, sigma, range_max = 0.9, (0.1 if "LINEAR" in FIELDS[name] else 1e-40), 0.2, LIMIT * RESOLUTION
    distance = np.minimum(np.sqrt(squared_distances(occupied)) * RESOLUTION, 1.5)
    table = np.pad(distance, 2, constant_values=1.5)
    terms = np.array([z_hit / (sigma * np.sqrt(2 * np.pi)), 0.5 / sigma**2, z_rand / range_max, 0.05])
    if "LOG_TABLE" in FIELDS[name]:
        table = np.log(terms[0] * np.exp(-0.5 * (table / sigma) ** 2) + terms[2])
    if "LINEAR" not in FIELDS[name]:
        terms[[0, 2]] = np.log(terms[[0, 2]])
    terms[3] = np.log(terms[3])
    heading = directions(np.float64)
    count = 150
    pose = np.empty((count, 4))
    pose[:, :2] = rng.choice([0, 0.25, 0.5, 0.75, 1 - 2.0**-30, 0.1, 0.3], (count, 2))
    pose[:, 2:] = heading[rng.integers(0, len(heading), count)]
    exact = pose.copy()
    pose, pose_low = split(exact, np.dtype(real))
    pose[:, :2] = np.minimum(pose[:, :2], np.nextafter(real(1), real(0)))
    pose_low = (exact - pose).astype(real)
    cell = np.stack([rng.integers(-5, occupied.shape[1] + 5, count), rng.integers(-5, occupied.shape[0] + 5, count)], 1)
    length = np.where(rng.random(77) < 0.5, rng.integers(0, 40, 77) * 0.25, rng.uniform(0, 40, 77))
    end = heading[rng.integers(0, len(heading), 77)] * length[:, None]
    end[:6] = [(0, 0), (1e6, 0), (-4e6, 3e6), (0.5, 0.5), (-0.5, 1e-9), (1e-20, -1e-20)]
    point, point_low = split(end, np.dtype(real))
    if all_readings:
        point[7::10], point[8::10] = np.nan, np.inf
        point_low[7::10], point_low[8::10] = 0, 0
    return {
        "table": table.astype(real),
        "pose_cell": cell.astype(np.int32),
        "pose": pose,
        "pose_low": pose_low,
        "point": point,
        "point_low": point_low,
        "terms": packed_with_low_parts(FieldTerms(*terms, 0.0, 0.0, 0.0, 0.0), real),
        "start": np.zeros(1, np.int32),
        "constant_terms": np.zeros(1, real),
        "log_p": np.empty(count, real),
        "parts": np.full((count, len(end)), np.nan, real),
    }


# As in models: float32 has end points in two parts, float64 in one.
FIELD_SCENES = [
    *(
        (name, names, np.float32)
        for name in FIELDS
        for names in (("TWO_PART_POINTS",), ("ALL_READINGS", "TWO_PART_POINTS"))
    ),
    *((name, names, np.float64) for name in FIELDS for names in ((), ("ALL_READINGS",))),
    ("log table", ("TWO_PART_POINTS", "ROUNDED_CELLS"), np.float32),
]


# ---- tiles

OCCUPIED = GRIDS["rooms"]
RANGE = LIMIT * RESOLUTION
WINDOW = window_of(OCCUPIED)
# Starts of the scans, not read for a single scan.
NOWHERE = np.zeros(1, np.int32)


def items(count: int, spread: int, group: int = TILE_PARTICLES, each: int = TILE) -> tuple[int]:
    """Return the size of a launch whose groups have ``group`` particles and ``each`` work-items."""
    return ((-(-count // group) << spread) * each,)


def poses(count: int, real: type) -> tuple[np.ndarray, np.ndarray]:
    cell, pose = adversarial_poses(OCCUPIED, real, outside=True)
    some = np.resize(np.arange(len(cell)), count)
    return cell[some], pose[some]


def rays_of(count: int, real: type) -> np.ndarray:
    return np.resize(directions(real), (count, 2))


def an_order(count: int) -> np.ndarray:
    return np.random.default_rng(count).permutation(count).astype(np.int32)


def parts_at(parts: np.ndarray, count: int, each: int) -> np.ndarray:
    """Return (count, each) parts, contiguous by reading."""
    return parts[: count * each].reshape(each, count).T


def room_for(count: int, each: int, real: type) -> np.ndarray:
    """Return an array for parts and one more number, filled with -77."""
    return np.full(count * each + 1, -77, real)


def guards_of(point: np.ndarray) -> np.ndarray:
    """Return the distance to an edge below which an end point of each block of readings is doubtful."""
    length = np.where(np.isfinite(point[:, 0]), np.hypot(*point.T), 0.0)
    longest = np.maximum.reduceat(length, np.arange(0, len(point), BLOCK_TERMS))
    return (_GUARD * np.finfo(point.dtype).eps * (longest + 2)).astype(point.dtype)
