"""Counter-based random numbers: a particle's numbers depend only on seed, step, stream and its index.

Philox 4x32-10: Salmon, Moraes, Dror and Shaw, *Parallel random numbers: as easy as 1, 2, 3* (2011). Normal deviates are
those of Box and Muller: sqrt(-2 log u) (cos 2 pi v, sin 2 pi v). The counter is (particle, step, stream, 0).
"""

from __future__ import annotations

import numpy as np

from gpusense.reference.elementary import log_of
from gpusense.reference.heading import cos_sin

MULTIPLIER_0, MULTIPLIER_1 = 0xD2511F53, 0xCD9E8D57
WEYL_0, WEYL_1 = 0x9E3779B9, 0xBB67AE85
ROUNDS = 10
WORD = 2.3283064365386963e-10
WORD_TURN = 1.4629180792671596e-09
Words = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
_MASK = np.uint64(0xFFFFFFFF)
_SHIFT = np.uint64(32)


def random_words(counter: Words, key_0: int, key_1: int) -> Words:
    """Return four random words of 32 bits for each counter of four words, as uint64."""
    c0, c1, c2, c3 = (np.asarray(word, np.uint64) for word in counter)
    for i in range(ROUNDS):
        k0, k1 = np.uint64((key_0 + i * WEYL_0) & 0xFFFFFFFF), np.uint64((key_1 + i * WEYL_1) & 0xFFFFFFFF)
        product_0, product_1 = c0 * np.uint64(MULTIPLIER_0), c2 * np.uint64(MULTIPLIER_1)
        c0, c1 = (product_1 >> _SHIFT) ^ c1 ^ k0, product_1 & _MASK
        c2, c3 = (product_0 >> _SHIFT) ^ c3 ^ k1, product_0 & _MASK
    return c0, c1, c2, c3


def uniform_of(word: np.ndarray) -> np.ndarray:
    """Return numbers in (0, 1), the centres of 2^32 intervals."""
    return (word.astype(np.float64) + 0.5) * WORD


def normal_pair(word_0: np.ndarray, word_1: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two independent standard normal deviates."""
    radius = np.sqrt(-2.0 * log_of(uniform_of(word_0)))
    cosine, sine = cos_sin(word_1.astype(np.float64) * WORD_TURN)
    return radius * cosine, radius * sine
