"""Sampled motions of particles: a first turn, a translation ahead and to the left, and a second turn."""

import warp as wp

from gpusense.interface import constants as c

from .elementary import angle_of
from .heading import cos_sin
from .philox import normal_pair, random_words, uniform_of
from .prelude import kernel

MOTION_STREAM, REVERSE_STREAM = wp.uint32(c.MOTION_STREAM), wp.uint32(c.MOTION_STREAM + 1)
SMALL_ARC, SIX = wp.float64(1e-4), wp.float64(6.0)
WHOLE_TURN, HALF_TURN = wp.float64(6.283185307179586), wp.float64(3.141592653589793)
# A full turn more than HALF_TURN, rounded down.
FARTHEST_ONCE = wp.float64(9.424777960769378)
MINUS_HALF_TURN = wp.float64(-3.141592653589793)
ZERO, ONE = wp.float64(0.0), wp.float64(1.0)


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
    step = wp.uint32(settings[c.STEP])
    key_0 = wp.uint32(settings[c.SEED])
    key_1 = wp.uint32(settings[c.SEED + 1])
    index = wp.uint32(n)
    words = random_words(index, step, MOTION_STREAM, key_0, key_1)
    one = normal_pair(words[0], words[1])
    two = normal_pair(words[2], words[3])
    first = settings[c.MEAN] + settings[c.DEVIATION] * one.x
    ahead = settings[c.MEAN + 1] + settings[c.DEVIATION + 1] * one.y
    left = settings[c.MEAN + 2] + settings[c.DEVIATION + 2] * two.x
    second = settings[c.MEAN + 3] + settings[c.DEVIATION + 3] * two.y
    if kind == c.VELOCITY_MODEL:
        ahead = chord_of(ahead, first)
        second = first + second
    if settings[c.REVERSE] > ZERO:
        more = random_words(index, step, REVERSE_STREAM, key_0, key_1)
        if uniform_of(more[0]) < settings[c.REVERSE]:
            ahead = -ahead
    x = source[3 * n]
    y = source[3 * n + 1]
    theta = source[3 * n + 2] + first
    turn = cos_sin(theta)
    target[3 * n] = x + (ahead * turn.x - left * turn.y)
    target[3 * n + 1] = y + (ahead * turn.y + left * turn.x)
    target[3 * n + 2] = wrap_any(theta + second)
