"""Rows of a map as bits, 1 where a cell is occupied: 32 cells a word, the first cell in the lowest bit."""

import warp as wp

from .prelude import by_device, reader

NONE = 0x7FFFFFFF
ALL_BITS = wp.uint32(0xFFFFFFFF)
word_at = reader(wp.int32)


# Return the index of the lowest 1 of a word that is not 0.
@wp.func_native(by_device("__ffs(word) - 1", "__builtin_ctz(word)"))
def lowest_bit(word: wp.uint32) -> wp.int32: ...


# Return the index of the highest 1 of a word that is not 0.
@wp.func_native(by_device("31 - __clz(word)", "31 - __builtin_clz(word)"))
def highest_bit(word: wp.uint32) -> wp.int32: ...


@wp.func
def occupied_at(bits: wp.array(dtype=wp.int32), begin: wp.int32, col: wp.int32):
    """Return whether a cell is occupied. The row begins at index begin."""
    return ((word_at(bits, begin + (col >> 5)) >> (col & 31)) & 1) != 0


@wp.func
def cells_right(bits: wp.array(dtype=wp.int32), begin: wp.int32, words: wp.int32, col: wp.int32, most: wp.int32):
    """Count the cells from a cell to the first occupied one to its right, itself included."""
    last = wp.min((col + most) >> 5, words - 1)
    i = col >> 5
    word = wp.uint32(word_at(bits, begin + i)) & (ALL_BITS << wp.uint32(col & 31))
    while word == wp.uint32(0) and i < last:
        i += 1
        word = wp.uint32(word_at(bits, begin + i))
    cells = int(NONE)
    if word != wp.uint32(0):
        cells = 32 * i + lowest_bit(word) - col
    return cells


@wp.func
def cells_left(bits: wp.array(dtype=wp.int32), begin: wp.int32, col: wp.int32, most: wp.int32):
    """Count the cells to the first occupied one to its left."""
    last = wp.max(col - most, 0) >> 5
    i = col >> 5
    word = wp.uint32(word_at(bits, begin + i)) & (ALL_BITS >> wp.uint32(31 - (col & 31)))
    while word == wp.uint32(0) and i > last:
        i -= 1
        word = wp.uint32(word_at(bits, begin + i))
    cells = int(NONE)
    if word != wp.uint32(0):
        cells = col - 32 * i - highest_bit(word)
    return cells
