"""Constants that the host shares with kernels.

The loader of OpenCL files defines the constants of a file, listed by ``OF_FILES``; Warp's files and the NumPy reference
import this module.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from gpusense.interface import feature_layout, formulas

# Kernel file error_free: terms of a block of a compensated sum, and strands that are summed side by side in a block.
BLOCK_TERMS, STRANDS = 16, 4
# Kernel file ray: rays and particles of a tile.
TILE_RAYS, TILE_PARTICLES = 4, 16
TILE = TILE_RAYS * TILE_PARTICLES
# Kernel file order: bins of an axis and of all three, and bins that a work-item of order_starts sums.
BINS = 32
ALL_BINS = BINS**3
STRETCH = 16
# Kernel file heading: up to this heading [rad] the counts of quarter turns have 20 bits.
LARGEST_HEADING = 1048576.0
# Kernel file rectangles: distance from a changed cell to the farthest cell whose rectangle contains it.
RECTANGLE_REACH = 254
# Kernel file scan: max readings are left out, are part of the constant term, or are evaluated like ranges.
MAX_LEFT_OUT, MAX_FIXED, MAX_PLACED = range(3)
# Kernel file end_point: cells around a field's window that hold the outside.
FIELD_RING = 2
# Kernel file relative: coordinates are clamped to this [m]; its square is finite in float32.
FARTHEST = float(1 << 60)
# Kernel files hit_shape and sampling: cells of a table, cells in a unit of its logarithmic coordinate, and numbers of a
# cell, by the bytes of a number.
TABLE_CELLS = {4: 256, 8: 1024}
TABLE_PER_LOG = {4: 16.0, 8: 27.0}
TABLE_POWERS = {4: 5, 8: 8}
# Kernel file absolute: distributions of a heading (a sum of normals, its Fourier series, von Mises); turns on either
# side and waves that are summed; exp(-NEGLIGIBLE) is below half an eps.
NEARBY, SERIES, VON_MISES = 0, 1, 2
WRAPS, WAVES = 3, 6
NEGLIGIBLE = 40
# Kernel file beacons: distributions of a range; numbers of a beacon: its place (x, its low part, y, its low part), the
# reading minus the bias with its low part, and the bias.
NORMAL, STUDENT_T, TWO_NORMALS = 0, 1, 2
BEACON = 7
# Kernel file ray_counts: fraction bits of a coordinate in cells.
RAY_BITS = 12
# Kernel file score_cells: columns of a run that a kernel in lanes reads at once, neighbouring rows of shifts that a
# work-item sums, each of which a table's margin holds; the largest score of a cell; and the points whose losses, in
# units of as many scores, fit a byte.
RUN, SHIFT_ROWS, TOP, FEW = 32, 8, 255, 4
# Kernel file icp_match: numbers of the result of a match, and of the rules of a level.
MATCH_RESULT, MATCH_RULES = 35, 14
# Kernel file field_gradient: numbers of a particle, log p, its gradient (3) and the information (9).
GRADIENT_NUMBERS = 13
# Kernel file field_climb: numbers of a climb, and of a pose's log p, gradient and half of its information.
CLIMB, CLIMB_SUMS = 19, 10
# Kernel files segments and circles: numbers of a line and of a circle.
LINE_NUMBERS, CIRCLE_NUMBERS = 6, 10


def strands_in(terms: int) -> int:
    """Return the number of strands of some terms: STRANDS per whole block, at most one per remaining term."""
    return terms // BLOCK_TERMS * STRANDS + min(terms % BLOCK_TERMS, STRANDS)


# Kernel files motion, weighing, drawing and estimate: numbers of a step's settings by place. SEED takes 2 places, MEAN
# and DEVIATION 4, POOL 4 (their number, and the half widths in which they are spread), and TEMPERATURE one per sensor.
SEED, STEP, MEAN, DEVIATION, REVERSE, JITTER, FARTHEST_X, FARTHEST_THETA, POOL = 0, 2, 3, 7, 11, 12, 13, 14, 15
SHARE, THRESHOLD, SCALE, PER_BEAM_SCALE, SLOW_RATE, FAST_RATE, MOST_INJECTED, STRATIFIED = range(19, 27)
TEMPERATURE = 27
# Kinds of draws, by the setting STRATIFIED.
SYSTEMATIC, INDEPENDENT, RESIDUAL = 0, 1, 2
# Factor of all rungs of a stage: 1, or less if even the last rung leaves too few particles with weight.
DEPTH = 60
SETTINGS = 61
# Streams of random numbers within a step; each stage of a correction has DRAW_STREAMS further streams.
MOTION_STREAM, DRAW_STREAM, DRAW_STREAMS = 0, 16, 4
# Kernel file sampling: first of its streams of random numbers, one per beam; numbers of a mixture; numbers of its
# settings by place. DRAW_SEED takes 2 places.
READING_STREAM, DRAW_TERMS = 1 << 30, 9
DRAW_SEED, DRAW_STEP, DRAW_FIRST, DRAW_PER_SCAN, DRAW_RANGE_MAX, DRAW_TOP, DRAW_MARGIN, DRAW_SETTINGS = 0, *range(2, 9)
# Classes of a beam: no evidence, it agrees, is short, passes through a wall, has no return where there is a wall.
NOTHING, AGREES, SHORT, THROUGH, VANISHED = range(5)
# Kinds of motion: a straight translation, or an arc.
STRAIGHT, VELOCITY_MODEL = 0, 1
# Rungs of the ladder of temperatures; columns of a block's sums: weights, their squares, and the weights before.
RUNGS = 8
WEIGHT_SUMS = 2 * RUNGS + 1
# Share of the temperature on the last rung.
LOWEST = 0.5 ** (RUNGS - 1)
# The state of a filter: numbers of each stage of a correction, then numbers that persist.
LEFT, TOTAL, SAMPLE_SIZE, RESAMPLED, DEGENERATE, RUNG = range(6)
STAGE = 8
EVIDENCE, SLOW, FAST, INJECTED = 48, 49, 50, 51
STATE = 64
# Kernel file estimate: sums of a block, numbers of an estimate (pose, covariance by rows of its upper half, the sum of
# weights, and 1 where headings are too far apart for one pass, or after the second pass the share of poses far off the
# mean), and lanes of a block.
ESTIMATE_SUMS, ESTIMATE, ESTIMATE_LANES = 13, 11, 8
MOMENTS, WIDE_HEADINGS, FAR_SHARE = 9, 10, 10
# Least errors of a pose far off [m, rad].
FAR, FAR_TURN = 1.0, 0.5


_NAMES = {
    "absolute": "NEARBY SERIES VON_MISES WRAPS WAVES NEGLIGIBLE",
    "beacons": "STUDENT_T TWO_NORMALS BEACON",
    "circles": "CIRCLE_NUMBERS",
    "drawing": """JITTER FARTHEST_X FARTHEST_THETA POOL SCALE STRATIFIED RESIDUAL DRAW_STREAM DRAW_STREAMS LEFT TOTAL
        RESAMPLED STAGE INJECTED WEIGHT_SUMS""",
    "end_point": "FIELD_RING",
    "error_free": "BLOCK_TERMS STRANDS",
    "estimate": "ESTIMATE_SUMS ESTIMATE_LANES FAR FAR_TURN WIDE_HEADINGS FAR_SHARE",
    "field_climb": "CLIMB CLIMB_SUMS",
    "field_gradient": "GRADIENT_NUMBERS",
    "elementary": "ROUNDER QUARTER HALF_TURN LOG2_HIGH LOG2_LOW INVERSE_LOG2 LEAST_EXPONENT SQRT_HALF EXP ODD",
    "heading": """LARGEST_HEADING ROUNDER QUARTER QUARTER_LOW TWO_OVER_PI QUARTER_1 QUARTER_2 QUARTER_3 QUARTER_4 S C
        WORDS""",
    "icp_match": "MATCH_RESULT MATCH_RULES",
    "motion": "SEED STEP MEAN DEVIATION REVERSE MOTION_STREAM VELOCITY_MODEL",
    "order": "BINS ALL_BINS STRETCH",
    "ray": "TILE_RAYS TILE_PARTICLES TILE",
    "ray_counts": "RAY_BITS",
    "rectangles": "RECTANGLE_REACH",
    "relative": "FARTHEST",
    "sampling": """READING_STREAM DRAW_TERMS DRAW_SEED DRAW_STEP DRAW_FIRST DRAW_PER_SCAN DRAW_RANGE_MAX DRAW_TOP
        DRAW_MARGIN HALF_WORD FINE NORMAL_PEAK MOST_HALF FARTHEST_HIT SHORT_SERIES SERIES_END HALF_FROM SERIES_TERMS
        FRACTION_TERMS CENTRAL CENTRAL_END CENTRAL_OFFSET OUTER_OFFSET OUTERMOST_OFFSET CENTRAL_OVER CENTRAL_UNDER
        OUTER_OVER OUTER_UNDER OUTERMOST_OVER OUTERMOST_UNDER""",
    "scan": "MAX_LEFT_OUT MAX_FIXED MAX_PLACED",
    "score_cells": "RUN SHIFT_ROWS TOP FEW",
    "segments": "LINE_NUMBERS",
    "weighing": """SHARE THRESHOLD SCALE PER_BEAM_SCALE SLOW_RATE FAST_RATE MOST_INJECTED TEMPERATURE DEPTH RUNGS LOWEST
        WEIGHT_SUMS LEFT TOTAL SAMPLE_SIZE RESAMPLED DEGENERATE RUNG STAGE EVIDENCE SLOW FAST INJECTED""",
}
# Kernel file math of bodies in lanes: powers of its polynomials, lowest first. Their relative errors are 2^-25.6 (E),
# 2^-27.2 (L), 2^-28.6 (A; of arctan t), 2^-24.2 (W; of erf) and 2^-24.4 (V; of 1 - log(erfc(x) / 2)).
POLYNOMIALS = {
    "E": (0.49999997, 0.166665465, 0.041667223, 0.00836638454, 0.00138791779),
    "L": (0.333333313, -0.250008196, 0.200012267, -0.166233569, 0.142017633, -0.131601855, 0.127615467, -0.0763445124),
    "A": (-0.333333164, 0.199984789, -0.14243634, 0.105943188, -0.0607896857),
    "W": (
        1.12837923, 0.636619389, 0.102777831, -0.0191530641, -0.000160394105, 0.00166702515, -0.000632835436,
        0.000117640826, -9.25621225e-06,
    ),
    "V": (
        1.12838185, 0.636580169, 0.102969967, -0.0195953287, 0.000385133055, 0.00129188842, -0.000495358487,
        9.69315297e-05, -1.02969989e-05, 4.69292473e-07,
    ),
}  # fmt: skip
_KNOWN: dict[str, Any] = vars(formulas) | globals()
# Constants of each kernel file, by name: numbers, tuples of coefficients, and lists.
OF_FILES: dict[str, dict[str, Any]] = {
    "landmarks": {name: value for name, value in vars(feature_layout).items() if isinstance(value, int)},
    "math": {f"{name}{i}": np.float32(power) for name, powers in POLYNOMIALS.items() for i, power in enumerate(powers)},
    **{file: {name: _KNOWN[name] for name in names.split()} for file, names in _NAMES.items()},
}


# ---- the numbers of a mixture as kernel arguments: whether densities or logarithms are summed, and rounding


# Above this peak [1/m] the rounding errors of an exponent may exceed the tolerance of a log density near 0.
HIGH_PEAK = 64.0
# The uniform density of a linear sum must be far above the size at which the other densities underflow, with or without
# denormals.
_SMALLEST_DENSITY = {np.dtype(np.float32): 1e-30, np.dtype(np.float64): 1e-290}


def sums_linearly(rand: float, peak: float, real: np.dtype) -> bool:
    """Return whether densities are summed: the uniform density is large enough relative to the other peaks."""
    return rand >= _SMALLEST_DENSITY[real] * max(peak, 1.0)


def rounded_terms(real: np.dtype, **terms: float) -> dict[str, np.floating]:
    """Return a mixture's numbers in a precision, with the rounding errors of the peak and scale of a hit."""
    with np.errstate(over="ignore"):
        rounded = dict(zip(terms, np.array(list(terms.values())).astype(real), strict=True))
    # Logarithms of zero weights are -inf; no other number may be infinite.
    if np.isposinf(list(rounded.values())).any() or rounded["square_scale"] < np.finfo(real).tiny:
        raise ValueError(f"parameters: sigma_hit and lambda_short must fit {real.name}, got terms {terms}")
    for name in ("hit_peak", "square_scale"):
        rounded[f"{name}_low"] = rounding_error(terms[name], rounded[name])
    return rounded


def rounding_error(exact: float, rounded: np.floating) -> np.floating:
    """Return the part of a number that rounding has removed, in the same precision; 0 for an infinite number."""
    low: np.floating = rounded.dtype.type(exact - float(rounded) if math.isfinite(exact) else 0.0)
    return low


def log_weight(weight: float) -> float:
    """Return the logarithm of a mixture weight; -inf for 0."""
    return math.log(weight) if weight > 0 else -math.inf
