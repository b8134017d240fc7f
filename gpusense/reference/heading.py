"""Cosine and sine of a heading in float64 with +, - and * alone, so that every device gives the same bits.

A heading is reduced to r + low, |r| <= pi/4, and a count of quarter turns modulo 4: up to 2^20 rad by subtracting the
count times pi/2 in four parts (Cody and Waite), for larger headings by an integer product with the relevant bits of
2/pi (Payne and Hanek). Then sin r = r + r z S(z) and cos r = 1 - z/2 + z^2 C(z) with z = r^2.
``bench/derive/heading_constants.py`` derives the constants.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface.constants import LARGEST_HEADING
from gpusense.reference.error_free import Pair, pair_product, two_sum

TWO_OVER_PI = 0.6366197723675814
# 1.5 * 2^52: adding it rounds to an integer.
ROUNDER = 6755399441055744.0
# pi/2 in three parts of 33 bits and a rounded one, and as the sum of two rounded numbers.
QUARTER_1, QUARTER_2 = 1.5707963267341256, 6.077100506303966e-11
QUARTER_3, QUARTER_4 = 2.0222662487111665e-21, 8.4784276603689e-32
QUARTER, QUARTER_LOW = 1.5707963267948966, 6.123233995736766e-17
# S and C, lowest power first; their relative errors are 2^-56.4 and 2^-59.6.
S0, S1, S2 = -0.1666666666666663, 0.008333333333322118, -0.00019841269829589585
S3, S4, S5 = 2.7557313621399067e-06, -2.505074776451535e-08, 1.5896230233207278e-10
C0, C1, C2 = 0.041666666666666595, -0.0013888888888873056, 2.4801587288851755e-05
C3, C4, C5 = -2.7557314179308847e-07, 2.087570084339475e-09, -1.1358536585312173e-11
# The bits of 2/pi in words of 32 after two words of zeros.
# fmt: off
WORDS = np.array([
    0x00000000, 0x00000000, 0xA2F9836E, 0x4E441529, 0xFC2757D1, 0xF534DDC0, 0xDB629599, 0x3C439041, 0xFE5163AB,
    0xDEBBC561, 0xB7246E3A, 0x424DD2E0, 0x06492EEA, 0x09D1921C, 0xFE1DEB1C, 0xB129A73E, 0xE88235F5, 0x2EBB4484,
    0xE99C7026, 0xB45F7E41, 0x3991D639, 0x835339F4, 0x9C845F8B, 0xBDF9283B, 0x1FF897FF, 0xDE05980F, 0xEF2F118B,
    0x5A0A6D1F, 0x6D367ECF, 0x27CB09B7, 0x4F463F66, 0x9E5FEA2D, 0x7527BAC7, 0xEBE5F17B, 0x3D0739F7, 0x8A5292EA,
    0x6BFB5FB1, 0x1F8D5D08, 0x56033046,
], np.uint64)
# fmt: on


def reduce_ordinary(theta: np.ndarray) -> tuple[np.ndarray, Pair]:
    """Reduce headings of at most LARGEST_HEADING to quarter turns modulo 4 and the sum of two numbers."""
    count = (theta * TWO_OVER_PI + ROUNDER) - ROUNDER
    # The first product and difference are exact, and so are the next two products.
    rest, lost_1 = two_sum(theta - count * QUARTER_1, -(count * QUARTER_2))
    rest, lost_2 = two_sum(rest, -(count * QUARTER_3))
    low = (lost_1 + lost_2) - count * QUARTER_4
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
    high, low = pair_product((high, low), (np.full_like(theta, QUARTER), np.full_like(theta, QUARTER_LOW)))
    back = theta < 0
    return np.where(back, -quadrant, quadrant) & 3, (np.where(back, -high, high), np.where(back, -low, low))


def cos_sin(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return cosines and sines of float64 headings; meaningless, but not NaN, for headings that are not finite."""
    huge = ~(np.abs(theta) <= LARGEST_HEADING)
    any_huge = huge.any()
    quadrant, (r, low) = reduce_ordinary(np.where(huge, 0.0, theta) if any_huge else theta)
    if any_huge:
        quadrant[huge], (r[huge], low[huge]) = reduce_huge(theta[huge])
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
