"""Cosine and sine of a heading in float64 with +, - and * alone, so that every device gives the same bits.

A heading is reduced to r + low, |r| <= pi/4, and a count of quarter turns modulo 4: up to 2^20 rad by subtracting the
count times pi/2 in four parts (Cody and Waite), for larger headings by an integer product with the relevant bits of
2/pi (Payne and Hanek). Then sin r = r + r z S(z) and cos r = 1 - z/2 + z^2 C(z) with z = r^2.
``bench/derive/heading_constants.py`` derives the constants.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface import formulas as f
from gpusense.interface.constants import LARGEST_HEADING
from gpusense.reference.error_free import Pair, pair_product, two_sum

S0, S1, S2, S3, S4, S5 = f.S
C0, C1, C2, C3, C4, C5 = f.C
WORDS = np.array(f.WORDS, np.uint64)


def reduce_ordinary(theta: np.ndarray) -> tuple[np.ndarray, Pair]:
    """Reduce headings of at most LARGEST_HEADING to quarter turns modulo 4 and the sum of two numbers."""
    count = (theta * f.TWO_OVER_PI + f.ROUNDER) - f.ROUNDER
    # The first product and difference are exact, and so are the next two products.
    rest, lost_1 = two_sum(theta - count * f.QUARTER_1, -(count * f.QUARTER_2))
    rest, lost_2 = two_sum(rest, -(count * f.QUARTER_3))
    low = (lost_1 + lost_2) - count * f.QUARTER_4
    return count.astype(np.int32) & 3, two_sum(rest, low)


def reduce_huge(theta: np.ndarray) -> tuple[np.ndarray, Pair]:
    """Reduce headings above LARGEST_HEADING, up to the largest number, as :func:`reduce_ordinary` does."""
    bits = np.abs(theta).view(np.uint64)
    mantissa = (bits & np.uint64(0xFFFFFFFFFFFFF)) | np.uint64(0x10000000000000)
    low_half, high_half = mantissa & np.uint64(0xFFFFFFFF), mantissa >> np.uint64(32)
    # Bits of 2/pi that contribute whole turns are left out: the window's first bit times the last bit of the mantissa
    # is half a turn.
    first = (bits >> np.uint64(52)).astype(np.int64) - (1075 - 62)
    word, shift = first >> 5, (first & 31).astype(np.uint64)
    # turns = mantissa * window modulo 2^192, of which the upper four words are kept.
    turn_1, turn_2, turn_3, turn_4, carry_1, carry_2, below = (np.zeros_like(bits) for _ in range(7))
    for k in (5, 4, 3, 2, 1, 0):
        both = WORDS[word + k] << np.uint64(32) | WORDS[word + k + 1]
        here = both << shift >> np.uint64(32)
        sum_1 = low_half * here + carry_1
        sum_2 = high_half * below + (sum_1 & np.uint64(0xFFFFFFFF)) + carry_2
        carry_1, carry_2, below = sum_1 >> np.uint64(32), sum_2 >> np.uint64(32), here
        turn_4, turn_3, turn_2, turn_1 = turn_3, turn_2, turn_1, sum_2 & np.uint64(0xFFFFFFFF)
    # Round to the nearest quarter. The rest, in units of 2^-62 quarters, is cut into pieces that convert without
    # rounding.
    turn_high = (turn_1 << np.uint64(32) | turn_2) + np.uint64(0x2000000000000000)
    turn_low = turn_3 << np.uint64(32) | turn_4
    quadrant = (turn_high >> np.uint64(62)).astype(np.int32)
    rest = (turn_high & np.uint64(0x3FFFFFFFFFFFFFFF)).astype(np.int64) - 0x2000000000000000
    piece_1, piece_2 = (rest >> 30) * 2.0**-32, (rest & 0x3FFFFFFF) * 2.0**-62
    piece_3 = (turn_low >> np.uint64(34)) * 2.0**-92
    piece_4 = ((turn_low >> np.uint64(4)) & np.uint64(0x3FFFFFFF)) * 2.0**-122
    total, lost = two_sum(piece_1, piece_2)
    high, low = two_sum(total, lost + (piece_3 + piece_4))
    high, low = pair_product((high, low), (np.full_like(theta, f.QUARTER), np.full_like(theta, f.QUARTER_LOW)))
    back = theta < 0
    return np.where(back, -quadrant, quadrant) & 3, (np.where(back, -high, high), np.where(back, -low, low))


def reduce_heading(theta: np.ndarray) -> tuple[np.ndarray, Pair]:
    """Reduce headings of any size, as :func:`reduce_ordinary` does."""
    huge = ~(np.abs(theta) <= LARGEST_HEADING)
    any_huge = huge.any()
    quadrant, rest = reduce_ordinary(np.where(huge, 0.0, theta) if any_huge else theta)
    if any_huge:
        quadrant[huge], (rest[0][huge], rest[1][huge]) = reduce_huge(theta[huge])
    return quadrant, rest


def cos_sin(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return cosines and sines of float64 headings; meaningless, but not NaN, for headings that are not finite."""
    quadrant, (r, low) = reduce_heading(theta)
    z = r * r
    half = 0.5 * z
    s = S0 + z * (S1 + z * (S2 + z * (S3 + z * (S4 + z * S5))))
    c = C0 + z * (C1 + z * (C2 + z * (C3 + z * (C4 + z * C5))))
    sine = r + (r * z * s + low * (1.0 - half))
    near = 1.0 - half
    cosine = near + (((1.0 - near) - half) + (z * z * c - r * low))
    odd = (quadrant & 1) != 0
    x, y = np.where(odd, sine, cosine), np.where(odd, cosine, sine)
    return np.where((quadrant + 1) & 2, -x, x), np.where(quadrant & 2, -y, y)
