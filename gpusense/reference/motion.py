"""Sampled motions of particles: a first turn, a translation ahead and to the left, and a second turn.

Odometry model: Thrun, Burgard and Fox, *Probabilistic Robotics* (2005), table 5.6; velocity model: table 5.3. Each of
the four parts is normal, with a mean and a deviation in the settings. An arc of the velocity model (VELOCITY_MODEL)
turns by twice the first part; its chord is the arc's length times sin(a) / a. With probability REVERSE the translation
goes the other direction: some odometers count wheel turns without their sign.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface.constants import DEVIATION, MEAN, MOTION_STREAM, REVERSE, SEED, STEP, VELOCITY_MODEL
from gpusense.reference.elementary import angle_of
from gpusense.reference.heading import cos_sin
from gpusense.reference.philox import normal_pair, random_words, uniform_of

SMALL_ARC = 1e-4
WHOLE_TURN, HALF_TURN = 6.283185307179586, 3.141592653589793
# A full turn more than HALF_TURN, rounded down.
FARTHEST_ONCE = 9.424777960769378


def chord_of(length: np.ndarray, half_turn: np.ndarray) -> np.ndarray:
    """Return the chord of an arc that turns by twice ``half_turn``."""
    small = np.abs(half_turn) < SMALL_ARC
    sine = cos_sin(half_turn)[1]
    return length * np.where(small, 1.0 - half_turn * half_turn / 6.0, sine / np.where(small, 1.0, half_turn))


def wrap_once(theta: np.ndarray) -> np.ndarray:
    """Wrap headings that are less than a turn outside [-pi, pi] to that interval."""
    return np.where(theta > HALF_TURN, theta - WHOLE_TURN, np.where(theta < -HALF_TURN, theta + WHOLE_TURN, theta))


def wrap_any(theta: np.ndarray) -> np.ndarray:
    """Wrap any heading to [-pi, pi]; headings more than a turn outside it by their cosine and sine."""
    far = np.abs(theta) > FARTHEST_ONCE
    wrapped = wrap_once(theta)
    if far.any():
        wrapped[far] = angle_of(*cos_sin(theta[far]))
    return wrapped


def move_particles(flags, source, settings, target, particles, kind):
    """Move particles from ``source`` to ``target``, which may be the same array."""
    n = np.arange(particles)
    zero = np.zeros(particles, np.uint64)
    step, key = zero + np.uint64(settings[STEP]), (int(settings[SEED]), int(settings[SEED + 1]))
    words = random_words((n, step, zero + np.uint64(MOTION_STREAM), zero), *key)
    d0, d1 = normal_pair(words[0], words[1])
    d2, d3 = normal_pair(words[2], words[3])
    first, ahead = settings[MEAN] + settings[DEVIATION] * d0, settings[MEAN + 1] + settings[DEVIATION + 1] * d1
    left, second = settings[MEAN + 2] + settings[DEVIATION + 2] * d2, settings[MEAN + 3] + settings[DEVIATION + 3] * d3
    if kind == VELOCITY_MODEL:
        ahead = chord_of(ahead, first)
        second = first + second
    if settings[REVERSE] > 0.0:
        words = random_words((n, step, zero + np.uint64(MOTION_STREAM + 1), zero), *key)
        ahead = np.where(uniform_of(words[0]) < settings[REVERSE], -ahead, ahead)
    pose = source[: 3 * particles].reshape(-1, 3)
    theta = pose[:, 2] + first
    cosine, sine = cos_sin(theta)
    moved = target[: 3 * particles].reshape(-1, 3)
    x = pose[:, 0] + (ahead * cosine - left * sine)
    y = pose[:, 1] + (ahead * sine + left * cosine)
    moved[:, 2] = wrap_any(theta + second)
    moved[:, 0], moved[:, 1] = x, y
