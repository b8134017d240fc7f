"""Constants of kernels that the host needs; the kernel files repeat them."""

from __future__ import annotations

# Kernel file error_free: terms of a block of a compensated sum, and strands that are summed side by side in a block.
BLOCK_TERMS, STRANDS = 16, 4
# Kernel file tiles: rays and particles of a tile.
TILE_RAYS, TILE_PARTICLES = 4, 16
TILE = TILE_RAYS * TILE_PARTICLES
# Kernel file order: bins of an axis and of all three, and bins that a work-item of order_starts sums.
BINS = 32
ALL_BINS = BINS**3
STRETCH = 16
# Kernel file heading: up to this heading [rad] the counts of quarter turns have 20 bits.
LARGEST_HEADING = 1048576.0
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
NEGLIGIBLE = 40.0
# Kernel file beacons: distributions of a range; numbers of a beacon: its place (x, its low part, y, its low part), the
# reading minus the bias with its low part, and the bias.
NORMAL, STUDENT_T, TWO_NORMALS = 0, 1, 2
BEACON = 7
# Kernel file ray_counts: fraction bits of a coordinate in cells.
RAY_BITS = 12
# Kernel file icp: numbers of the result of a match, and of the rules of a level.
MATCH_RESULT, MATCH_RULES = 35, 14
# Kernel file field_gradient: numbers of a particle, log p, its gradient (3) and the information (9).
GRADIENT_NUMBERS = 13
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
