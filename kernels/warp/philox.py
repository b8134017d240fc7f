"""Counter-based random numbers: a particle's numbers depend only on seed, step, stream and its index."""

import warp as wp

from .elementary import log_of
from .heading import cos_sin

MULTIPLIER_0, MULTIPLIER_1 = wp.uint64(0xD2511F53), wp.uint64(0xCD9E8D57)
WEYL_0, WEYL_1 = wp.uint32(0x9E3779B9), wp.uint32(0xBB67AE85)
# 2^-32, and that many turns in radians.
WORD, WORD_TURN = wp.float64(2.3283064365386963e-10), wp.float64(1.4629180792671596e-09)
HALF, MINUS_TWO = wp.float64(0.5), wp.float64(-2.0)
SHIFT, NONE = wp.uint64(32), wp.uint32(0)
words_4 = wp.types.vector(length=4, dtype=wp.uint32)


@wp.func
def random_words(particle: wp.uint32, step: wp.uint32, stream: wp.uint32, key_0: wp.uint32, key_1: wp.uint32):
    """Return four random words for a counter."""
    c = words_4(particle, step, stream, NONE)
    k0 = key_0
    k1 = key_1
    for _i in range(10):
        product_0 = wp.uint64(c[0]) * MULTIPLIER_0
        product_1 = wp.uint64(c[2]) * MULTIPLIER_1
        high_0 = wp.uint32(product_0 >> SHIFT)
        high_1 = wp.uint32(product_1 >> SHIFT)
        c = words_4(high_1 ^ c[1] ^ k0, wp.uint32(product_1), high_0 ^ c[3] ^ k1, wp.uint32(product_0))
        k0 = k0 + WEYL_0
        k1 = k1 + WEYL_1
    return c


@wp.func
def uniform_of(word: wp.uint32):
    """Return numbers in (0, 1), the centres of 2^32 intervals."""
    return (wp.float64(word) + HALF) * WORD


@wp.func
def normal_pair(word_0: wp.uint32, word_1: wp.uint32):
    """Return two independent standard normal deviates."""
    radius = wp.sqrt(MINUS_TWO * log_of(uniform_of(word_0)))
    turn = cos_sin(wp.float64(word_1) * WORD_TURN)
    return wp.vec2d(radius * turn.x, radius * turn.y)
