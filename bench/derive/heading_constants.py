"""Derive the constants of ``heading`` in the three kernel languages with mpmath, and print them and their errors.

Sines and cosines are minimax polynomials (Remez's exchange, relative error) in z = r^2 for |r| <= pi/4: sin r = r + r z
S(z), cos r = 1 - z/2 + z^2 C(z). pi/2 is split into parts whose products with counts are exact, and 2/pi into words of
32 bits.
"""

from __future__ import annotations

import sys
from pathlib import Path

import mpmath as mp

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from derive.lane_constants import polynomial, remez

# 2/pi is needed to 1184 bits.
mp.mp.dps = 400
# Largest r^2, with a margin for counts that are rounded to the wrong side.
END = (mp.pi / 4) ** 2 * (1 + mp.mpf(2) ** -30)
COEFFICIENTS = 6
# Bits of each part of pi/2 except the last, and of the words of 2/pi.
PART_BITS, WORD_BITS = 33, 32
# Two words of zeros come first. A number below 2^1024 needs the bits up to 2^-969 and 192 more.
ZERO_WORDS, WORDS = 2, 39


def polynomials() -> tuple[list[float], list[float]]:
    """Return the coefficients of S and of C, rounded."""
    root, sin, cos = mp.sqrt, mp.sin, mp.cos
    grid = [END * (1 - mp.cos(mp.pi * i / 1000)) / 2 for i in range(1, 1001)]
    sine = remez(lambda z: (sin(root(z)) / root(z) - 1) / z, lambda z: z * root(z) / sin(root(z)), grid, COEFFICIENTS)
    cosine = remez(lambda z: (cos(root(z)) - 1 + z / 2) / z**2, lambda z: z**2 / cos(root(z)), grid, COEFFICIENTS)
    return [float(c) for c in sine], [float(c) for c in cosine]


def errors(sine: list[float], cosine: list[float]) -> tuple[float, float]:
    """Return base-2 logarithms of the largest relative errors of the sine and the cosine."""
    worst = [mp.mpf(0), mp.mpf(0)]
    for i in range(1, 2001):
        z = END * i / 2000
        r = mp.sqrt(z)
        found = r + r * z * polynomial(sine, z), 1 - z / 2 + z * z * polynomial(cosine, z)
        for k, (value, truth) in enumerate(zip(found, (mp.sin(r), mp.cos(r)), strict=True)):
            worst[k] = max(worst[k], abs(value / truth - 1))
    return float(mp.log(worst[0], 2)), float(mp.log(worst[1], 2))


def quarter_parts() -> list[float]:
    """Split pi/2 into three parts of 33 bits and a rounded fourth."""
    rest, parts = mp.pi / 2, []
    for i in range(3):
        scale = mp.mpf(2) ** (PART_BITS * (i + 1) - 1)
        parts.append(float(mp.floor(rest * scale) / scale))
        rest -= parts[-1]
    return [*parts, float(rest)]


def quarter_pair() -> list[float]:
    """Return pi/2 as the sum of two rounded numbers."""
    high = float(mp.pi / 2)
    return [high, float(mp.pi / 2 - high)]


def words() -> list[int]:
    """Return the first bits of 2/pi in words of 32 bits, after the zeros."""
    bits = int(mp.floor(2 / mp.pi * mp.mpf(2) ** (WORD_BITS * (WORDS - ZERO_WORDS))))
    shifts = range(WORD_BITS * (WORDS - ZERO_WORDS - 1), -1, -WORD_BITS)
    return [0] * ZERO_WORDS + [bits >> shift & (1 << WORD_BITS) - 1 for shift in shifts]


def main() -> None:
    """Print everything."""
    quarter, pair, two_over_pi = quarter_parts(), quarter_pair(), words()
    mp.mp.dps = 50
    sine, cosine = polynomials()
    sine_error, cosine_error = errors(sine, cosine)
    print("S", sine, f"relative error 2^{sine_error:.1f}")
    print("C", cosine, f"relative error 2^{cosine_error:.1f}")
    print("2/pi", float(2 / mp.pi))
    print("pi/2 in parts", quarter)
    print("pi/2 as a pair", pair)
    print("words of 2/pi", ", ".join(f"0x{word:08X}" for word in two_over_pi))


if __name__ == "__main__":
    main()
