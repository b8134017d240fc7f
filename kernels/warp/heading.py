"""Cosine and sine of a heading in float64 with +, - and * alone, so that every device gives the same bits."""

import warp as wp

from .flags import HUGE_HEADINGS
from .float64.error_free import pair_product, two_sum

# Up to this heading the counts of quarter turns have 20 bits.
LARGEST_HEADING = wp.constant(wp.float64(1048576.0))
TWO_OVER_PI = wp.constant(wp.float64(0.6366197723675814))
# 1.5 * 2^52: adding it rounds to an integer.
ROUNDER = wp.constant(wp.float64(6755399441055744.0))
# pi/2 in three parts of 33 bits and a rounded one, and as the sum of two rounded numbers.
QUARTER_1 = wp.constant(wp.float64(1.5707963267341256))
QUARTER_2 = wp.constant(wp.float64(6.077100506303966e-11))
QUARTER_3 = wp.constant(wp.float64(2.0222662487111665e-21))
QUARTER_4 = wp.constant(wp.float64(8.4784276603689e-32))
QUARTER = wp.constant(wp.float64(1.5707963267948966))
QUARTER_LOW = wp.constant(wp.float64(6.123233995736766e-17))
# S and C, lowest power first; their relative errors are 2^-56.4 and 2^-59.6.
S0 = wp.constant(wp.float64(-0.1666666666666663))
S1 = wp.constant(wp.float64(0.008333333333322118))
S2 = wp.constant(wp.float64(-0.00019841269829589585))
S3 = wp.constant(wp.float64(2.7557313621399067e-06))
S4 = wp.constant(wp.float64(-2.505074776451535e-08))
S5 = wp.constant(wp.float64(1.5896230233207278e-10))
C0 = wp.constant(wp.float64(0.041666666666666595))
C1 = wp.constant(wp.float64(-0.0013888888888873056))
C2 = wp.constant(wp.float64(2.4801587288851755e-05))
C3 = wp.constant(wp.float64(-2.7557314179308847e-07))
C4 = wp.constant(wp.float64(2.087570084339475e-09))
C5 = wp.constant(wp.float64(-1.1358536585312173e-11))
ZERO, HALF, ONE = wp.constant(wp.float64(0.0)), wp.constant(wp.float64(0.5)), wp.constant(wp.float64(1.0))
# Values of the pieces of a turn, in quarters.
PIECE_1, PIECE_2 = wp.constant(wp.float64(2.0**-32)), wp.constant(wp.float64(2.0**-62))
PIECE_3, PIECE_4 = wp.constant(wp.float64(2.0**-92)), wp.constant(wp.float64(2.0**-122))
# The bits of 2/pi in words of 32 after two words of zeros.
# fmt: off
WORDS = wp.constant(wp.types.vector(length=39, dtype=wp.uint32)(
    0x00000000, 0x00000000, 0xA2F9836E, 0x4E441529, 0xFC2757D1, 0xF534DDC0, 0xDB629599, 0x3C439041, 0xFE5163AB,
    0xDEBBC561, 0xB7246E3A, 0x424DD2E0, 0x06492EEA, 0x09D1921C, 0xFE1DEB1C, 0xB129A73E, 0xE88235F5, 0x2EBB4484,
    0xE99C7026, 0xB45F7E41, 0x3991D639, 0x835339F4, 0x9C845F8B, 0xBDF9283B, 0x1FF897FF, 0xDE05980F, 0xEF2F118B,
    0x5A0A6D1F, 0x6D367ECF, 0x27CB09B7, 0x4F463F66, 0x9E5FEA2D, 0x7527BAC7, 0xEBE5F17B, 0x3D0739F7, 0x8A5292EA,
    0x6BFB5FB1, 0x1F8D5D08, 0x56033046,
))
# fmt: on
MASK_52, ONE_52 = wp.constant(wp.uint64(0xFFFFFFFFFFFFF)), wp.constant(wp.uint64(0x10000000000000))
MASK_32, MASK_30 = wp.constant(wp.uint64(0xFFFFFFFF)), wp.constant(wp.uint64(0x3FFFFFFF))
MASK_62, EIGHTH = wp.constant(wp.uint64(0x3FFFFFFFFFFFFFFF)), wp.constant(wp.uint64(0x2000000000000000))
SIGNED_MASK_30, SIGNED_EIGHTH = wp.constant(wp.int64(0x3FFFFFFF)), wp.constant(wp.int64(0x2000000000000000))


@wp.func
def reduce_ordinary(theta: wp.float64):
    """Reduce a heading of at most LARGEST_HEADING to quarter turns modulo 4 and the sum of two numbers."""
    count = (theta * TWO_OVER_PI + ROUNDER) - ROUNDER
    # The first product and difference are exact, and so are the next two products.
    first = two_sum(theta - count * QUARTER_1, -(count * QUARTER_2))
    second = two_sum(first.x, -(count * QUARTER_3))
    low = (first.y + second.y) - count * QUARTER_4
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
    angle = pair_product(quarters, wp.vec2d(QUARTER, QUARTER_LOW))
    back = theta < ZERO
    return wp.where(back, -quadrant, quadrant) & 3, wp.where(back, wp.vec2d(-angle.x, -angle.y), angle)


@wp.func
def cos_sin(theta: wp.float64):
    """Return (cosine, sine) of a heading; for a heading that is not finite they are meaningless, but not NaN."""
    quadrant = int(0)
    rest = wp.vec2d()
    if HUGE_HEADINGS:
        if wp.abs(theta) <= LARGEST_HEADING:
            quadrant, rest = reduce_ordinary(theta)
        else:
            quadrant, rest = reduce_huge(theta)
    else:
        quadrant, rest = reduce_ordinary(theta)
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
