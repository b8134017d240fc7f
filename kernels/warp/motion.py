"""Sampled motions of particles: a first turn, a translation ahead and to the left, and a second turn.

Odometry model: Thrun, Burgard and Fox, *Probabilistic Robotics* (2005), table 5.6; velocity model: table 5.3. Each of
the four parts is normal, with a mean and a deviation in the settings. An arc of the velocity model (VELOCITY_MODEL)
turns by twice the first part; its chord is the arc's length times sin(a) / a. With probability REVERSE the translation
goes the other direction: some odometers count wheel turns without their sign.
"""

import warp as wp

from .elementary import angle_of
from .heading import cos_sin
from .philox import normal_pair, random_words, uniform_of
from .prelude import kernel

SEED, STEP, MEAN, DEVIATION, REVERSE = (wp.constant(place) for place in (0, 2, 3, 7, 11))
MOTION_STREAM, REVERSE_STREAM = wp.constant(wp.uint32(0)), wp.constant(wp.uint32(1))
VELOCITY_MODEL = wp.constant(1)
SMALL_ARC, SIX = wp.constant(wp.float64(1e-4)), wp.constant(wp.float64(6.0))
WHOLE_TURN, HALF_TURN = wp.constant(wp.float64(6.283185307179586)), wp.constant(wp.float64(3.141592653589793))
# A full turn more than HALF_TURN, rounded down.
FARTHEST_ONCE = wp.constant(wp.float64(9.424777960769378))
MINUS_HALF_TURN = wp.constant(wp.float64(-3.141592653589793))
ZERO, ONE = wp.constant(wp.float64(0.0)), wp.constant(wp.float64(1.0))


@wp.func
def chord_of(length: wp.float64, half_turn: wp.float64):
    """Return the chord of an arc that turns by twice half_turn."""
    chord = length * (ONE - half_turn * half_turn / SIX)
    if wp.abs(half_turn) >= SMALL_ARC:
        turn = cos_sin(half_turn)
        chord = length * (turn.y / half_turn)
    return chord


@wp.func
def wrap_once(theta: wp.float64):
    """Wrap headings that are less than a turn outside [-pi, pi] to that interval."""
    less = wp.where(theta < MINUS_HALF_TURN, theta + WHOLE_TURN, theta)
    return wp.where(theta > HALF_TURN, theta - WHOLE_TURN, less)


@wp.func
def wrap_any(theta: wp.float64):
    """Wrap any heading to [-pi, pi]; headings more than a turn outside it by their cosine and sine."""
    wrapped = wrap_once(theta)
    if wp.abs(theta) > FARTHEST_ONCE:
        turn = cos_sin(theta)
        wrapped = angle_of(turn.x, turn.y)
    return wrapped


@kernel
def move_particles(source, settings, target, particles, kind):
    """Move particles from source to target, which may be the same array: one work-item takes a particle."""
    n = wp.tid()
    if n >= particles:
        return
    step = wp.uint32(settings[STEP])
    key_0 = wp.uint32(settings[SEED])
    key_1 = wp.uint32(settings[SEED + 1])
    index = wp.uint32(n)
    words = random_words(index, step, MOTION_STREAM, key_0, key_1)
    one = normal_pair(words[0], words[1])
    two = normal_pair(words[2], words[3])
    first = settings[MEAN] + settings[DEVIATION] * one.x
    ahead = settings[MEAN + 1] + settings[DEVIATION + 1] * one.y
    left = settings[MEAN + 2] + settings[DEVIATION + 2] * two.x
    second = settings[MEAN + 3] + settings[DEVIATION + 3] * two.y
    if kind == VELOCITY_MODEL:
        ahead = chord_of(ahead, first)
        second = first + second
    if settings[REVERSE] > ZERO:
        more = random_words(index, step, REVERSE_STREAM, key_0, key_1)
        if uniform_of(more[0]) < settings[REVERSE]:
            ahead = -ahead
    x = source[3 * n]
    y = source[3 * n + 1]
    theta = source[3 * n + 2] + first
    turn = cos_sin(theta)
    target[3 * n] = x + (ahead * turn.x - left * turn.y)
    target[3 * n + 1] = y + (ahead * turn.y + left * turn.x)
    target[3 * n + 2] = wrap_any(theta + second)
