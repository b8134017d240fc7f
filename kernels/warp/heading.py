"""Cosine and sine of a heading in float64 with +, - and * alone, so that every device gives the same bits."""

import warp as wp

from gpusense.interface import constants, formulas

from .flags import HUGE_HEADINGS
from .float64.error_free import pair_product, two_sum
from .prelude import doubles

f = doubles(formulas)
# A name of the module, which generated code copies once a function, not once a use.
WORDS = f.WORDS
LARGEST_HEADING = wp.float64(constants.LARGEST_HEADING)
S0, S1, S2, S3, S4, S5 = map(wp.float64, formulas.S)
C0, C1, C2, C3, C4, C5 = map(wp.float64, formulas.C)
ZERO, HALF, ONE = wp.float64(0.0), wp.float64(0.5), wp.float64(1.0)
# Values of the pieces of a turn, in quarters.
PIECE_1, PIECE_2 = wp.float64(2.0**-32), wp.float64(2.0**-62)
PIECE_3, PIECE_4 = wp.float64(2.0**-92), wp.float64(2.0**-122)
MASK_52, ONE_52 = wp.uint64(0xFFFFFFFFFFFFF), wp.uint64(0x10000000000000)
MASK_32, MASK_30 = wp.uint64(0xFFFFFFFF), wp.uint64(0x3FFFFFFF)
MASK_62, EIGHTH = wp.uint64(0x3FFFFFFFFFFFFFFF), wp.uint64(0x2000000000000000)
SIGNED_MASK_30, SIGNED_EIGHTH = wp.int64(0x3FFFFFFF), wp.int64(0x2000000000000000)


@wp.func
def reduce_ordinary(theta: wp.float64):
    """Reduce a heading of at most LARGEST_HEADING to quarter turns modulo 4 and the sum of two numbers."""
    count = (theta * f.TWO_OVER_PI + f.ROUNDER) - f.ROUNDER
    # The first product and difference are exact, and so are the next two products.
    first = two_sum(theta - count * f.QUARTER_1, -(count * f.QUARTER_2))
    second = two_sum(first.x, -(count * f.QUARTER_3))
    low = (first.y + second.y) - count * f.QUARTER_4
    return int(count) & 3, two_sum(second.x, low)


@wp.func
def reduce_huge(theta: wp.float64):
    """Reduce a heading above LARGEST_HEADING, up to the largest number."""
    bits = wp.cast(wp.abs(theta), wp.uint64)
    mantissa = (bits & MASK_52) | ONE_52
    low_half = mantissa & MASK_32
    high_half = mantissa >> wp.uint64(32)
    # Bits of 2/pi that contribute whole turns are left out: the window's first bit times the last bit of the
    # mantissa is half a turn.
    first = int(bits >> wp.uint64(52)) - (1075 - 62)
    word = first >> 5
    shift = wp.uint64(first & 31)
    # turns = mantissa * window modulo 2^192, of which the upper four words are kept.
    turn_1 = wp.uint64(0)
    turn_2 = wp.uint64(0)
    turn_3 = wp.uint64(0)
    turn_4 = wp.uint64(0)
    carry_1 = wp.uint64(0)
    carry_2 = wp.uint64(0)
    below = wp.uint64(0)
    for i in range(6):
        k = 5 - i
        both = wp.uint64(WORDS[word + k]) << wp.uint64(32) | wp.uint64(WORDS[word + k + 1])
        here = both << shift >> wp.uint64(32)
        sum_1 = low_half * here + carry_1
        sum_2 = high_half * below + (sum_1 & MASK_32) + carry_2
        carry_1 = sum_1 >> wp.uint64(32)
        carry_2 = sum_2 >> wp.uint64(32)
        below = here
        turn_4 = turn_3
        turn_3 = turn_2
        turn_2 = turn_1
        turn_1 = sum_2 & MASK_32
    # Round to the nearest quarter. The rest, in units of 2^-62 quarters, is cut into pieces that convert without
    # rounding.
    turn_high = (turn_1 << wp.uint64(32) | turn_2) + EIGHTH
    turn_low = turn_3 << wp.uint64(32) | turn_4
    quadrant = int(turn_high >> wp.uint64(62))
    rest = wp.int64(turn_high & MASK_62) - SIGNED_EIGHTH
    piece_1 = wp.float64(rest >> wp.int64(30)) * PIECE_1
    piece_2 = wp.float64(rest & SIGNED_MASK_30) * PIECE_2
    piece_3 = wp.float64(turn_low >> wp.uint64(34)) * PIECE_3
    piece_4 = wp.float64((turn_low >> wp.uint64(4)) & MASK_30) * PIECE_4
    total = two_sum(piece_1, piece_2)
    quarters = two_sum(total.x, total.y + (piece_3 + piece_4))
    angle = pair_product(quarters, wp.vec2d(f.QUARTER, f.QUARTER_LOW))
    back = theta < ZERO
    return wp.where(back, -quadrant, quadrant) & 3, wp.where(back, wp.vec2d(-angle.x, -angle.y), angle)


@wp.func
def reduce_heading(theta: wp.float64):
    """Reduce a heading of any size; without HUGE_HEADINGS, of at most LARGEST_HEADING."""
    quadrant = int(0)
    rest = wp.vec2d()
    if HUGE_HEADINGS:
        if wp.abs(theta) <= LARGEST_HEADING:
            quadrant, rest = reduce_ordinary(theta)
        else:
            quadrant, rest = reduce_huge(theta)
    else:
        quadrant, rest = reduce_ordinary(theta)
    return quadrant, rest


@wp.func
def cos_sin(theta: wp.float64):
    """Return (cosine, sine) of a heading; for a heading that is not finite they are meaningless, but not NaN."""
    quadrant, rest = reduce_heading(theta)
    r = rest.x
    low = rest.y
    z = r * r
    half = HALF * z
    s = S0 + z * (S1 + z * (S2 + z * (S3 + z * (S4 + z * S5))))
    c = C0 + z * (C1 + z * (C2 + z * (C3 + z * (C4 + z * C5))))
    sine = r + (r * z * s + low * (ONE - half))
    near = ONE - half
    cosine = near + (((ONE - near) - half) + (z * z * c - r * low))
    odd = (quadrant & 1) != 0
    x = wp.where(odd, sine, cosine)
    y = wp.where(odd, cosine, sine)
    return wp.vec2d(wp.where(((quadrant + 1) & 2) != 0, -x, x), wp.where((quadrant & 2) != 0, -y, y))
