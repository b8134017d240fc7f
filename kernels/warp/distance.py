"""Exact squared Euclidean distance transform in cells (Meijster, Roerdink and Hesselink 2000): all integers.

A pass works on parallel lines of a grid. Line i starts at i * line_stride; its cells are step apart. The host
decides which axis goes first, so that neighbouring work-items read neighbouring cells where that pays. The grid has
fewer than 2^31 cells, so indices fit int32.
"""

import warp as wp

from .prelude import kernel

NO_OBSTACLE = wp.constant(-1)
UNREACHABLE = wp.constant(0x7FFFFFFF)


# First pass, one work-item a line: cells to the nearest occupied cell of the same line, NO_OBSTACLE without one.
@kernel
def distance_lines(
    occupied: wp.array(dtype=wp.uint8),
    along: wp.array(dtype=wp.int32),
    lines: wp.int32,
    length: wp.int32,
    line_stride: wp.int32,
    step: wp.int32,
):
    line = wp.tid()
    if line >= lines:
        return
    begin = line * line_stride
    nearest = int(NO_OBSTACLE)
    for i in range(length):
        if occupied[begin + i * step] != wp.uint8(0):
            nearest = i
        if nearest == NO_OBSTACLE:
            along[begin + i * step] = NO_OBSTACLE
        else:
            along[begin + i * step] = i - nearest
    nearest = int(NO_OBSTACLE)
    for i in range(length - 1, -1, -1):
        if occupied[begin + i * step] != wp.uint8(0):
            nearest = i
        if nearest != NO_OBSTACLE:
            before = along[begin + i * step]
            after = nearest - i
            if before == NO_OBSTACLE or after < before:
                along[begin + i * step] = after


# Squared distance from cell i to the obstacle nearest to cell j across the lines.
@wp.func
def parabola(i: wp.int32, j: wp.int32, across: wp.int32):
    return (i - j) * (i - j) + across * across


# Second pass, one work-item a line: lower envelope of the parabolas of the first pass. The vertices wait in
# squared, which a line overwrites from its far end: entry q of the stack never lies beyond the cell that reads it.
@kernel
def distance_envelope(
    along: wp.array(dtype=wp.int32),
    starts: wp.array(dtype=wp.int32),
    squared: wp.array(dtype=wp.int32),
    lines: wp.int32,
    length: wp.int32,
    line_stride: wp.int32,
    step: wp.int32,
):
    line = wp.tid()
    if line >= lines:
        return
    first = line * line_stride
    top = int(-1)
    for i in range(length):
        g = along[first + i * step]
        if g != NO_OBSTACLE:
            begin = int(0)
            while top >= 0:
                v = squared[first + top * step]
                gv = along[first + v * step]
                s = starts[first + top * step]
                if parabola(s, v, gv) <= parabola(s, i, g):
                    # The parabolas cross at s or later, so nothing here is negative and division truncates.
                    begin = (i * i - v * v + g * g - gv * gv) // (2 * (i - v)) + 1
                    break
                top -= 1
            if begin < length:
                top += 1
                squared[first + top * step] = i
                starts[first + top * step] = wp.where(top == 0, 0, begin)
    for i in range(length - 1, -1, -1):
        if top < 0:
            squared[first + i * step] = UNREACHABLE
        else:
            v = squared[first + top * step]
            s = starts[first + top * step]
            squared[first + i * step] = parabola(i, v, along[first + v * step])
            if s == i:
                top -= 1


_KERNELS = {"distance_lines": distance_lines, "distance_envelope": distance_envelope}


def make(name, flags):
    """A kernel of this file; no flag changes it."""
    return _KERNELS[name]
